"""Matches the exposure of two images of a camera."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["same_exposure"]

_LEAST_CONTRAST = 8.0  # grey levels between the quartiles; images with less contrast are not matched
_GAIN, _OFFSET = 1.15, 8.0  # largest differences in contrast and grey level between frames of the same exposure


def same_exposure(first: np.ndarray, second: np.ndarray, *, tolerance: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Returns both images with the quartiles of the one with more contrast; images without contrast are unchanged.

    Args:
        first: grey image ``[H, W]``, uint8.
        second: grey image ``[H, W]``, uint8.
        tolerance: do not change images with a small difference, as between frames of the same exposure.

    Returns:
        Both, ``[H, W]``, uint8.

    Example:
        >>> dark = np.arange(100, dtype=np.uint8).reshape(10, 10)
        >>> bool((same_exposure(dark, 2 * dark)[0] == 2 * dark).all())
        True
    """
    (low, high), (other_low, other_high) = (np.percentile(image, (25, 75)) for image in (first, second))
    if high - low > other_high - other_low:
        return same_exposure(second, first, tolerance=tolerance)[::-1]
    if high - low < _LEAST_CONTRAST:
        return first, second
    gain = (other_high - other_low) / (high - low)
    if tolerance and gain < _GAIN and abs(low + high - other_low - other_high) < 2 * _OFFSET:
        return first, second
    matched = cv2.convertScaleAbs(np.maximum(gain * (first.astype(np.float32) - low) + other_low, 0))
    return matched, second
