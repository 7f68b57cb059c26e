"""Disturbances of a camera's images: dead and hot pixels, defocus, exposure, black frames, occlusion.

The first two and the box are the robustness tests of the DEnKF paper's KITTI code, relative to the image size instead
of in pixels of 1242 x 375. Images are ``[*B, C, H, W]``, uint8 in [0, 255] or floating in [0, 1], and keep their dtype;
every frame has its own draws. Append a disturbance to an environment with images (after ``ToTensorImage``), or call it
on data. Derived entries must be computed from disturbed frames: for a drive, disturb ``image``, from which
:func:`torch_denkf.applications.car.kitti.frames.drive_frames` and :class:`torch_denkf.applications.car.KITTIReplayEnv`
compute difference images afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torch_denkf.envs._frames import ImageDisturbance, scale_of, to_dtype, to_float

__all__ = ["BlackFrames", "Blur", "Brightness", "OccludingBox", "SaltAndPepper"]


class SaltAndPepper(ImageDisturbance):
    """Makes a share of the pixels white and as many others black, in all channels.

    The counts are exact: ``round(fraction * H * W)`` of each, drawn again for each frame.

    Args:
        fraction: share of white pixels, and of black ones; by default 9000 each of 1242 x 375 (the paper's code draws
            8000 to 10000).
        p: probability that a frame is disturbed.
        in_keys: entries of the frame ``[*B, C, H, W]``.
        generator: source of randomness, on the images' device; torch's global one by default.

    Raises:
        ValueError: if ``fraction`` is not in [0, 0.5] or ``p`` not in [0, 1].

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"pixels": torch.full((2, 3, 10, 20), 0.5)}, [2])
        >>> pixels = SaltAndPepper(0.1)(td)["pixels"]
        >>> (pixels == 1).sum((-1, -2)).tolist(), (pixels == 0).sum((-1, -2)).tolist()
        ([[20, 20, 20], [20, 20, 20]], [[20, 20, 20], [20, 20, 20]])
    """

    def __init__(
        self,
        fraction: float = 9000 / (1242 * 375),
        *,
        p: float = 1.0,
        in_keys: tuple[NestedKey, ...] = ("pixels",),
        generator: torch.Generator | None = None,
    ):
        if not isinstance(fraction, (int, float)) or not 0.0 <= fraction <= 0.5:
            raise ValueError(f"fraction is the share of white pixels and that of black ones, <= 0.5; got {fraction!r}.")
        super().__init__(p, in_keys=in_keys, generator=generator)
        self.fraction = fraction

    def _disturb(self, frames: Tensor) -> Tensor:
        n, channels, height, width = frames.shape
        count = min(round(self.fraction * height * width), height * width // 2)
        noise = torch.rand(n, height * width, generator=self.generator, device=frames.device)
        # The largest random values select random pixels; the first half of them becomes white.
        place = noise.topk(2 * count, -1).indices.unsqueeze(1).expand(-1, channels, -1)
        value = torch.zeros(2 * count, dtype=frames.dtype, device=frames.device)
        value[:count] = scale_of(frames)
        return frames.flatten(-2).scatter(-1, place, value.expand(n, channels, -1)).reshape(frames.shape)


class Blur(ImageDisturbance):
    """Applies a box blur: each pixel becomes the mean of the ``kernel`` around it, without padding at the border.

    Args:
        kernel: side in pixels, odd, or (height, width); by default the odd number next to 15/1242 of the frame's width
            and at least 3: the paper's code blurs KITTI's 1242 columns with 15 x 15.
        p: probability that a frame is disturbed.
        in_keys: entries of the frame ``[*B, C, H, W]``.
        generator: source of randomness, on the images' device; torch's global one by default.

    Raises:
        ValueError: if a side is not odd and positive or ``p`` not in [0, 1].

    Example:
        >>> from tensordict import TensorDict
        >>> image = torch.zeros(1, 5, 5)
        >>> image[0, 2, 2] = 0.9
        >>> Blur(3)(TensorDict({"pixels": image}))["pixels"][0, 1]
        tensor([0.0000, 0.1000, 0.1000, 0.1000, 0.0000])
    """

    def __init__(
        self,
        kernel: int | tuple[int, int] | None = None,
        *,
        p: float = 1.0,
        in_keys: tuple[NestedKey, ...] = ("pixels",),
        generator: torch.Generator | None = None,
    ):
        sides = (kernel, kernel) if isinstance(kernel, int) else kernel
        odd = isinstance(sides, Sequence) and all(isinstance(side, int) and side > 0 and side % 2 for side in sides)
        if sides is not None and (not odd or len(sides) != 2):
            raise ValueError(
                f"kernel is a positive odd number of pixels, or one each for height and width; got {kernel!r}."
            )
        super().__init__(p, in_keys=in_keys, generator=generator)
        self.kernel = sides

    def _disturb(self, frames: Tensor) -> Tensor:
        side = max(3, 2 * int(15 / 1242 * frames.shape[-1] / 2) + 1)
        height, width = (side, side) if self.kernel is None else self.kernel
        # The box is separable, and so is its number of pixels inside the image.
        values = _mean_filter(to_float(frames), (height, 1))
        return to_dtype(_mean_filter(values, (1, width)), frames)


def _mean_filter(values: Tensor, kernel: tuple[int, int]) -> Tensor:
    padding = (kernel[0] // 2, kernel[1] // 2)
    return avg_pool2d(values, kernel, stride=1, padding=padding, count_include_pad=False)


class Brightness(ImageDisturbance):
    """Draws an exposure for each frame: ``gain * value + offset``, clamped to black and white.

    Args:
        gain: bounds of the uniform factor.
        offset: bounds of the uniform offset, relative to white.
        p: probability that a frame is disturbed.
        in_keys: entries of the frame ``[*B, C, H, W]``.
        generator: source of randomness, on the images' device; torch's global one by default.

    Raises:
        ValueError: if an upper bound is below the lower one, a gain is negative, or ``p`` is not in [0, 1].

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"pixels": torch.tensor([[[0, 100, 200]]], dtype=torch.uint8)})
        >>> Brightness(gain=(1.5, 1.5), offset=(0.2, 0.2))(td)["pixels"]
        tensor([[[ 51, 201, 255]]], dtype=torch.uint8)
    """

    def __init__(
        self,
        gain: tuple[float, float] = (0.5, 1.5),
        offset: tuple[float, float] = (-0.1, 0.1),
        *,
        p: float = 1.0,
        in_keys: tuple[NestedKey, ...] = ("pixels",),
        generator: torch.Generator | None = None,
    ):
        for name, bounds in (("gain", gain), ("offset", offset)):
            if len(bounds) != 2 or not all(isinstance(bound, (int, float)) for bound in bounds):
                raise TypeError(f"{name} is (lowest, highest), two numbers; got {bounds!r}.")
            if not -math.inf < bounds[0] <= bounds[1] < math.inf:
                raise ValueError(f"{name} is (lowest, highest), equal for a constant; got {bounds}.")
        if gain[0] < 0:
            raise ValueError(f"a gain cannot be negative; got {gain}.")
        super().__init__(p, in_keys=in_keys, generator=generator)
        self.gain, self.offset = tuple(gain), tuple(offset)

    def _disturb(self, frames: Tensor) -> Tensor:
        values = to_float(frames)
        draw = torch.rand(2, len(frames), 1, 1, 1, generator=self.generator, device=frames.device).to(values.dtype)
        (weakest, strongest), (darkest, brightest) = values.new_tensor(self.gain), values.new_tensor(self.offset)
        gain, offset = torch.lerp(weakest, strongest, draw[0]), torch.lerp(darkest, brightest, draw[1])
        return to_dtype(gain * values + offset * scale_of(frames), frames)


class BlackFrames(ImageDisturbance):
    """Makes whole frames black; unlike ``MissingFrames``, no mask tells the filter.

    Args:
        p: probability that a frame is black.
        in_keys: entries of the frame ``[*B, C, H, W]``.
        generator: source of randomness, on the images' device; torch's global one by default.

    Raises:
        ValueError: if ``p`` is no probability.

    Example:
        >>> from tensordict import TensorDict
        >>> td = BlackFrames(1.0)(TensorDict({"pixels": torch.ones(2, 3, 4, 4)}, [2]))
        >>> float(td["pixels"].sum()), "observed" in td
        (0.0, False)
    """

    def __init__(
        self,
        p: float = 0.3,
        *,
        in_keys: tuple[NestedKey, ...] = ("pixels",),
        generator: torch.Generator | None = None,
    ):
        super().__init__(p, in_keys=in_keys, generator=generator)

    def _disturb(self, frames: Tensor) -> Tensor:
        return torch.zeros_like(frames)


class OccludingBox(ImageDisturbance):
    """Occludes a part of the image by a box.

    Append it to a replay to train a sensor's visibility estimate; see :class:`~torch_denkf.imperfect.Visibility`.

    Args:
        size: shares of the frame's height and width; by default 150 x 150 pixels of KITTI's 375 x 1242.
        position: the box's upper left corner as shares of the height and the width, by default row 100 and column 500
            of 375 x 1242, as in the paper's code; the box is clipped to the image. ``None`` draws a position for each
            frame, uniformly among those with the box inside the image.
        fill: content of the box: ``"black"``; ``"blur"``, a box blur of a quarter of the image's width; or ``"noise"``,
            independent pixels between black and white.
        p: probability that a frame is disturbed.
        in_keys: entries of the frame ``[*B, C, H, W]``.
        generator: source of randomness, on the images' device; torch's global one by default.

    Raises:
        ValueError: if a share or ``p`` is not in [0, 1], or ``fill`` is none of the three.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"pixels": torch.ones(1, 4, 4)})
        >>> OccludingBox(size=(0.5, 0.25), position=(0.25, 0.5))(td)["pixels"].int().tolist()
        [[[1, 1, 1, 1], [1, 1, 0, 1], [1, 1, 0, 1], [1, 1, 1, 1]]]
    """

    def __init__(
        self,
        size: tuple[float, float] = (150 / 375, 150 / 1242),
        position: tuple[float, float] | None = (100 / 375, 500 / 1242),
        *,
        fill: Literal["black", "blur", "noise"] = "black",
        p: float = 1.0,
        in_keys: tuple[NestedKey, ...] = ("pixels",),
        generator: torch.Generator | None = None,
    ):
        for name, shares in (("size", size), ("position", position)):
            good = isinstance(shares, Sequence) and all(isinstance(s, (int, float)) and 0 <= s <= 1 for s in shares)
            if shares is not None and (not good or len(shares) != 2):
                raise ValueError(f"{name} is a share of the height and one of the width, in [0, 1]; got {shares!r}.")
        if fill not in ("black", "blur", "noise"):
            raise ValueError(f'fill is "black", "blur" or "noise"; got {fill!r}.')
        super().__init__(p, in_keys=in_keys, generator=generator)
        self.size, self.position, self.fill = tuple(size), position, fill

    def _disturb(self, frames: Tensor) -> Tensor:
        rows, columns = (self._side(axis, frames) for axis in (0, 1))
        box = (rows[:, :, None] & columns[:, None, :]).unsqueeze(1)
        if self.fill == "black":
            return frames.masked_fill(box, 0)
        values = to_float(frames)
        if self.fill == "blur":
            side = max(3, 2 * (frames.shape[-1] // 8) + 1)
            inside = _mean_filter(_mean_filter(values, (side, 1)), (1, side))
        else:
            draw = torch.rand(values.shape, generator=self.generator, device=values.device, dtype=values.dtype)
            inside = draw * scale_of(frames)
        return torch.where(box, to_dtype(inside, frames), frames)

    def _side(self, axis: int, frames: Tensor) -> Tensor:
        """Masks the rows, or columns, of each frame that the box covers, ``[n, H]`` or ``[n, W]``."""
        length, count = frames.shape[axis - 2], len(frames)
        side = round(self.size[axis] * length)
        if self.position is None:
            free = length - side
            draw = torch.rand(count, 1, generator=self.generator, device=frames.device)
            first = (draw * (free + 1)).long()
        else:
            first = torch.full((count, 1), round(self.position[axis] * length), device=frames.device)
        place = torch.arange(length, device=frames.device)
        return (place >= first) & (place < first + side)
