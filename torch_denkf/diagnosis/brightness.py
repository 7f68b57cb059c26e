"""Checks the brightness of the first image of a sensor."""

from __future__ import annotations

import warnings

import torch
from tensordict import NestedKey

from torch_denkf._checks import has_values

__all__ = ["look_at_brightness"]

#: No image in [0, 1] has such a value, and hardly a standardised one; nearly every image in [0, 255] has.
_TOO_BRIGHT = 10.0


def look_at_brightness(key: NestedKey, pixels: torch.Tensor) -> bool:
    """Warns if floating pixels are far from [0, 1]; returns False if there were no values to check.

    Args:
        key: of the pixels, for the message.
        pixels: as the network reads them.
    """
    if not pixels.numel() or not has_values(pixels):
        return False
    largest = float(pixels.detach().abs().nan_to_num().max())
    if largest > _TOO_BRIGHT:
        warnings.warn(
            f"ImageSensor reads {key!r} in floating point up to {largest:.0f}; it expects [0, 1]. Give it uint8 "
            "images, which it divides by 255, or divide them; with pixel_loc and pixel_scale in the units of the "
            "pixels any range will do. Said once.",
            stacklevel=3,
        )
    return largest > 0  # specs are tried out on zeros
