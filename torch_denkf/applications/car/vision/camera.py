"""Canonical camera, which makes images independent of intrinsics and resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torch_denkf._checks import check_number

__all__ = ["CanonicalCamera", "KITTI_HEIGHT"]

KITTI_HEIGHT = 1.65  # m, height of KITTI's cameras over the road (Geiger et al. 2013, figure 3)

# Tangents of half the angles of view; KITTI's cameras have 0.85 to 0.87 horizontally and 0.24 to 0.28 vertically.
_HALF_WIDTH, _HALF_HEIGHT = 0.86, 0.27


@dataclass(frozen=True)
class CanonicalCamera:
    """A pinhole camera with a fixed field of view and its principal point in the middle.

    Its image coordinates are ``x = (column - (width - 1) / 2) / focal`` (to the right) and the same for ``y`` (down):
    tangents of angles from the optical axis.

    Attributes:
        focal: focal length in pixels.
    """

    focal: float

    def __post_init__(self):
        check_number("focal", self.focal, above=0, cure="It is in pixels")

    @classmethod
    def near(cls, calibration) -> CanonicalCamera:
        """Returns the canonical camera with a resolution near a real camera's ``(fx, fy, cx, cy)``, in pixels.

        Small images are enlarged to a focal length of 120 pixels, below which dense optical flow fails on the road, and
        large ones scaled down to 240, beyond which accuracy does not improve.
        """
        return cls(min(max(0.96 * float(calibration[0]), 120.0), 240.0))

    @property
    def width(self) -> int:
        """Returns the number of columns."""
        return round(2 * _HALF_WIDTH * self.focal) + 1

    @property
    def height(self) -> int:
        """Returns the number of rows."""
        return round(2 * _HALF_HEIGHT * self.focal) + 1

    def view(self, image: np.ndarray, calibration) -> np.ndarray:
        """Resamples a real camera's image for this camera; outside of it, the border is repeated.

        Args:
            image: ``[H, W]``, uint8.
            calibration: the real camera's ``(fx, fy, cx, cy)``, in pixels of ``image``.

        Returns:
            ``[height, width]``, uint8.
        """
        import cv2  # imported here, as sensors and filters need no OpenCV

        fx, fy, cx, cy = (float(value) for value in calibration)
        if fx > 1.5 * self.focal:  # linear interpolation would skip pixels
            height, width = image.shape
            size = round(width * self.focal / fx), round(height * self.focal / fx)
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            across, down = size[0] / width, size[1] / height
            fx, cx = fx * across, (cx + 0.5) * across - 0.5  # pixel centres are at whole numbers
            fy, cy = fy * down, (cy + 0.5) * down - 0.5
        x, y = fx / self.focal, fy / self.focal
        to_real = np.array([[x, 0, cx - x * (self.width - 1) / 2], [0, y, cy - y * (self.height - 1) / 2]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(image, to_real, (self.width, self.height), flags=flags, borderMode=cv2.BORDER_REPLICATE)

    def pixels(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns columns and rows (float32, fractional) of image coordinates."""
        columns = x * self.focal + (self.width - 1) / 2
        rows = y * self.focal + (self.height - 1) / 2
        return columns.astype(np.float32), rows.astype(np.float32)
