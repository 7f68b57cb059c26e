"""Camera model: lens distortion, motion blur and sensor noise of a rendered image."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["Camera", "distortion_map"]


def distortion_map(size: tuple[int, int], k1: float, k2: float) -> tuple[np.ndarray, np.ndarray]:
    """Maps each pixel of the distorted picture to the ideal one: x and y in pixels, ``[H, W]`` each.

    Brown's radial polynomial (1966) from the distorted to the ideal radius, ``r (1 - k1 r^2 - k2 r^4)``, which is the
    usual model's inverse to first order; r is one at the middle of the upper edge. Negative k1 is a barrel. The
    picture is then enlarged about its middle until none of it lies outside the ideal one.
    """
    height, width = size
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = (x - (width - 1) / 2) / (height / 2), (y - (height - 1) / 2) / (height / 2)
    square = x**2 + y**2
    scale = 1 - k1 * square - k2 * square**2
    scale /= max(1.0, float(scale.max()))
    return x * scale * (height / 2) + (width - 1) / 2, y * scale * (height / 2) + (height - 1) / 2


class Camera:
    """Applies the lens and the sensor of a camera to drawn pictures.

    Args:
        size: (H, W) in pixels.
        distortion: k1 and k2, see :func:`distortion_map`.
        noise: standard deviation of the noise at black and at white, in grey levels of 255.
    """

    def __init__(self, size: tuple[int, int], distortion: tuple[float, float], noise: tuple[float, float]):
        self._map = distortion_map(size, *distortion) if any(distortion) else None
        self._noise = noise

    def lens(self, picture: np.ndarray) -> np.ndarray:
        """Returns the picture ``[H, W, 3]`` as the lens bends it."""
        if self._map is None:
            return picture
        return cv2.remap(picture, *self._map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def expose(self, pictures: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """Exposes one frame, uint8 ``[H, W, 3]``: the mean of the pictures, bent by the lens, with sensor noise."""
        if len(pictures) == 1 and self._map is None and not any(self._noise):
            return pictures[0]
        light = self.lens(np.stack(pictures).mean(0, dtype=np.float32) if len(pictures) > 1 else pictures[0])
        light = light.astype(np.float32)
        dark, bright = self._noise
        if dark or bright:
            deviation = np.float32(dark) + light * np.float32((bright - dark) / 255)
            light = light + deviation * rng.standard_normal(light.shape, dtype=np.float32)
        return cv2.convertScaleAbs(np.maximum(light, 0.0))  # rounds and saturates
