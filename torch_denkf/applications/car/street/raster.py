"""Helpers for drawing: regions of an image, pyramid levels, interpolation between coarse columns."""

from __future__ import annotations

import numpy as np


def hats(pixels: int, step: int) -> np.ndarray:
    """Returns weights that interpolate linearly between pixels 0, ``step``, 2 ``step`` ...: ``[nodes, pixels]``."""
    nodes = np.arange(0, pixels + step, step)
    return np.maximum(1 - np.abs(np.arange(pixels) - nodes[:, None]) / step, 0).astype(np.float32)


def region(corners: np.ndarray, shape: tuple[int, ...]) -> tuple[int, int, int, int] | None:
    """Returns the bounding box x0, y0, x1, y1 of points, clipped to the image; None if it is empty.

    Args:
        corners: pixels (x, y), ``[n, 2]``.
        shape: shape of the image.
    """
    (left, top), (right, bottom) = corners.min(0), corners.max(0)
    x0, y0 = max(int(np.floor(left)), 0), max(int(np.floor(top)), 0)
    x1, y1 = min(int(np.ceil(right)) + 1, shape[1]), min(int(np.ceil(bottom)) + 1, shape[0])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def level(minification: float, levels: int) -> int:
    """Returns the pyramid level with the pixel size nearest to the image's."""
    return int(np.clip(np.round(np.log2(max(minification, 1e-6))), 0, levels - 1))


def hidden(pixels: np.ndarray, ahead: np.ndarray, solid: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Masks objects that are outside the image or fully occluded by nearer solid ones.

    Args:
        pixels: bottom and top corners of objects on the ground, the nearest first, ``[n, 2, 4, 2]``.
        ahead: whether all corners are in front of the camera, ``[n]``; other objects count as visible.
        solid: whether an object is opaque from its bottom to its lowest top corner, ``[n]``.
        shape: shape of the image.

    Returns:
        ``[n]`` bool.
    """
    cell = 4  # pixels
    height, width = shape[:2]
    left, right = pixels[..., 0].min((1, 2)).tolist(), pixels[..., 0].max((1, 2)).tolist()
    top, bottom = pixels[..., 1].min((1, 2)), pixels[..., 1].max((1, 2))
    outside = ahead & ((top >= height) | (bottom < 0))
    top, roof = top.tolist(), pixels[:, 1, :, 1].max(-1).tolist()
    covered = np.full(width // cell + 1, np.inf)  # from this row on
    gone = outside.copy()
    for k in np.flatnonzero(ahead & ~outside).tolist():
        first, last = int(max(left[k], 0.0)), int(min(right[k] + 1, width))
        if first >= last or top[k] > covered[first // cell : -(-last // cell)].max() + 1:
            gone[k] = True
        elif solid[k]:
            inside = slice(
                -(-(first + 1) // cell) if left[k] > 0 else 0, (last - 1) // cell if right[k] < width else None
            )
            np.minimum(covered[inside], roof[k], out=covered[inside])
    return gone
