"""What goes wrong with the camera's pictures: in training at random, in tests one by one."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.transforms import SaltAndPepper

BOX = 0.3  # side of a box over the hand, in widths of the picture
SHIFT = 10 / 320  # of a camera that was pushed, in widths of the picture
DARK = 0.45  # share of the light that is left


def shifted(pixels: Tensor, right: int, down: int) -> Tensor:
    """Pictures ``[*, H, W]`` moved by whole pixels; the edges are repeated."""
    height, width = pixels.shape[-2:]
    rows = (torch.arange(height) - down).clamp(0, height - 1)
    columns = (torch.arange(width) - right).clamp(0, width - 1)
    return pixels[..., rows, :][..., columns]


def boxed(pixels: Tensor, place: Tensor, side: float = BOX) -> Tensor:
    """Pictures ``[N, 3, H, W]`` with a black box around places ``[N, 2]`` from -1 (left, top) to 1."""
    height, width = pixels.shape[-2:]
    half = side * width / 2
    column, row = (place[:, 0] + 1) / 2 * width, (place[:, 1] + 1) / 2 * height
    inside = ((torch.arange(width) + 0.5 - column.unsqueeze(-1)).abs() < half).unsqueeze(-2)
    inside = inside & ((torch.arange(height) + 0.5 - row.unsqueeze(-1)).abs() < half).unsqueeze(-1)
    return pixels * ~inside.unsqueeze(1)


def disturb(pixels: Tensor, place: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Training frames: other light and colours for all; noise, shifts, boxes, salt and pepper for some.

    Args:
        pixels: ``[N, 3, H, W]`` in [0, 1]; changed in place.
        place: of the hand, ``[N, 2]``.
        generator: of all random numbers.

    Returns:
        The frames, and how far the hand moved in them, ``[N, 2]``.
    """
    count, width = len(pixels), pixels.shape[-1]

    def draw(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator)

    gain = (0.75 + 0.45 * draw(1, 1, 1)) * (0.92 + 0.16 * draw(3, 1, 1))
    gain = torch.where(draw(1, 1, 1) < 0.1, gain * (0.4 + 0.5 * draw(1, 1, 1)), gain)
    pixels.mul_(gain).add_(0.1 * draw(1, 1, 1) - 0.05)
    which, far, moved = draw(), draw(2) * 2 - 1, torch.zeros(count, 2)
    height = pixels.shape[-2]
    for k in (which < 0.5).nonzero().flatten().tolist():
        reach = width * (1.2 * SHIFT if which[k] < 0.15 else 0.25 * SHIFT)
        right, down = (round(float(step) * reach) for step in far[k])
        pixels[k] = shifted(pixels[k], right, down)
        moved[k] = torch.tensor([2 * right / width, 2 * down / height])
    some = (draw() < 0.4).nonzero().flatten()
    noise = torch.randn(pixels[some].shape, generator=generator)
    pixels[some] += 0.03 * noise
    hidden = (draw() < 0.35).nonzero().flatten()
    around = place[hidden] + moved[hidden] + 0.5 * (draw(2)[hidden] * 2 - 1)
    away = draw()[hidden].unsqueeze(-1) < 0.6  # most boxes lie elsewhere
    around = torch.where(away, 2 * draw(2)[hidden] - 1, around)
    for k, spot, side in zip(hidden.tolist(), around, draw()[hidden], strict=True):
        pixels[k : k + 1] = boxed(pixels[k : k + 1], spot.unsqueeze(0), 0.1 + 0.25 * float(side))
    salted = (draw() < 0.15).nonzero().flatten()
    frames = TensorDict({"pixels": pixels[salted]}, batch_size=[len(salted)])
    pixels[salted] = SaltAndPepper(generator=generator)(frames)["pixels"]
    return pixels.clamp_(0, 1), moved
