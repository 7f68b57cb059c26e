"""Disturbs the camera's images: in training at random, in tests one by one."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.envs import SaltAndPepper

BOX = 0.3  # side of a box over the hand, in widths of the image
SHIFT = 10 / 320  # of a camera that was pushed, in widths of the image
DARK = 0.45  # share of the light that remains
PICTURES = ("clean", "salt_and_pepper", "box", "shifted", "dark")  # conditions that change images
MARGIN = (0.16, 0.3)  # between the hand's middle and another episode's table, in widths of the image


def shifted(pixels: Tensor, right: int, down: int) -> Tensor:
    """Returns images ``[*, H, W]`` moved by whole pixels; the edges are repeated."""
    height, width = pixels.shape[-2:]
    rows = (torch.arange(height) - down).clamp(0, height - 1)
    columns = (torch.arange(width) - right).clamp(0, width - 1)
    return pixels[..., rows, :][..., columns]


def boxed(pixels: Tensor, place: Tensor, side: float = BOX) -> Tensor:
    """Returns images ``[N, 3, H, W]`` with a black box around places ``[N, 2]`` from -1 (left, top) to 1."""
    height, width = pixels.shape[-2:]
    half = side * width / 2
    column, row = (place[:, 0] + 1) / 2 * width, (place[:, 1] + 1) / 2 * height
    inside = ((torch.arange(width) + 0.5 - column.unsqueeze(-1)).abs() < half).unsqueeze(-2)
    inside = inside & ((torch.arange(height) + 0.5 - row.unsqueeze(-1)).abs() < half).unsqueeze(-1)
    return pixels * ~inside.unsqueeze(1)


def before_another(pixels: Tensor, place: Tensor, other: Tensor, margin: float) -> Tensor:
    """Returns the arm of one image in front of the table of another, uint8 ``[3, H, W]``.

    The arm reaches in from the right and from below. The region to the left of the hand or above it comes from the
    other image.

    Args:
        pixels: with the arm.
        place: of the hand, ``[2]`` from -1 (left, top) to 1.
        other: with the table.
        margin: kept around the hand's middle, in widths of the image.
    """
    height, width = pixels.shape[-2:]
    column, row = (float(place[0]) + 1) / 2 * width, (float(place[1]) + 1) / 2 * height
    left, top = (max(int(middle - margin * width), 0) for middle in (column, row))
    out = other.clone()
    out[:, top:, left:] = pixels[:, top:, left:]
    return out


def disturb(pixels: Tensor, place: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Augments training frames: light and colours of all; noise, shifts, boxes, salt and pepper in some.

    Args:
        pixels: uint8 ``[N, 3, H, W]``; changed in place.
        place: of the hand, ``[N, 2]``.
        generator: of all random numbers.

    Returns:
        The frames, about in [0, 1], and the hand's displacement in them, ``[N, 2]``.
    """
    count, height, width = len(pixels), *pixels.shape[-2:]

    def draw(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator)

    which, far, moved = draw(), draw(2) * 2 - 1, torch.zeros(count, 2)
    for k in (which < 0.5).nonzero().flatten().tolist():
        reach = width * (1.2 * SHIFT if which[k] < 0.15 else 0.25 * SHIFT)
        right, down = (round(float(step) * reach) for step in far[k])
        pixels[k] = shifted(pixels[k], right, down)
        moved[k] = torch.tensor([2 * right / width, 2 * down / height])
    gain = (0.75 + 0.45 * draw(1, 1, 1)) * (0.92 + 0.16 * draw(3, 1, 1))
    gain = torch.where(draw(1, 1, 1) < 0.1, gain * (0.4 + 0.5 * draw(1, 1, 1)), gain)
    frames = pixels.float().mul_(gain / 255).add_(0.1 * draw(1, 1, 1) - 0.05)
    for k in (draw() < 0.3).nonzero().flatten().tolist():
        frames[k] += 0.03 * torch.randn(frames[k].shape, generator=generator)
    near, side, elsewhere = draw(2) * 2 - 1, 0.1 + 0.25 * draw(), draw(2) * 2 - 1
    for k in (draw() < 0.35).nonzero().flatten().tolist():
        # Most boxes lie anywhere, the others at the hand.
        spot = elsewhere[k] if float(which[k]) * 10 % 1 < 0.6 else place[k] + moved[k] + 0.5 * near[k]
        frames[k : k + 1] = boxed(frames[k : k + 1], spot.unsqueeze(0), float(side[k]))
    salted = (draw() < 0.15).nonzero().flatten()
    some = TensorDict({"pixels": frames[salted]}, batch_size=[len(salted)])
    frames[salted] = SaltAndPepper(generator=generator)(some)["pixels"]
    return frames, moved


def failing(pixels: Tensor, place: Tensor, condition: str, draw: Tensor, exact: bool) -> Tensor:
    """Returns images of a failing camera.

    Args:
        pixels: ``[N, 3, H, W]`` in [0, 1].
        place: of the hand, ``[N, 2]``.
        condition: one of :data:`PICTURES`.
        draw: four numbers in [0, 1) that set size and direction of the failure in this episode.
        exact: whether sizes are those of the tests instead of drawn ones: box, light, a shift of 10 px of 320.
    """
    first, second, third, fourth = draw.tolist()
    if condition == "salt_and_pepper":
        generator = torch.Generator().manual_seed(int(first * 2**31))
        fraction = {} if exact else {"fraction": 0.04 * second}
        return SaltAndPepper(generator=generator, **fraction)(TensorDict({"pixels": pixels}, [len(pixels)]))["pixels"]
    if condition == "box":
        off = torch.tensor([second - 0.5, third - 0.5]) * 0.3
        return boxed(pixels, place) if exact else boxed(pixels, place + off, BOX * (0.7 + 0.8 * first))
    if condition == "shifted":
        reach = SHIFT * pixels.shape[-1] * (1 if exact else 1.4 * first)
        down = round(reach * (second - 0.5)) if not exact else 0
        return shifted(pixels, round(reach if third < 0.5 else -reach), down)
    if condition == "dark":
        return pixels * (DARK if exact else 0.3 + 0.6 * fourth)
    return pixels
