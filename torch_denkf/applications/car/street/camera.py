"""A pinhole camera, in KITTI's axes: x right, y down, z forward, in metres."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

HEIGHT = 1.65  # m: height of KITTI's cameras above the road
KITTI_FOCAL = 718.856 / 1241  # focal length of the odometry benchmark, relative to the image's width


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel centres are at whole numbers.

    Attributes:
        size: (H, W) in pixels.
        fx: horizontal focal length in pixels; fy is the vertical one, (cx, cy) the principal point.
        height: height of the camera above the ground, in m.
    """

    size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    height: float = HEIGHT

    @classmethod
    def kitti(cls, size: tuple[int, int]) -> Camera:
        """Returns KITTI's left colour camera of the raw drives (1242 x 375), scaled to ``size``; for level poses."""
        return cls._scaled(size, (375, 1242), 721.5, 610.1, 173.4)

    @classmethod
    def odometry(cls, size: tuple[int, int], focal: float = KITTI_FOCAL) -> Camera:
        """Returns the left camera of the odometry drives (1241 x 376), scaled to ``size``; its pitch is 1° downward.

        Args:
            size: (H, W) in pixels.
            focal: focal length relative to the width.
        """
        return cls._scaled(size, (376, 1241), focal * 1241, 607.1928, 185.2157)

    @classmethod
    def _scaled(cls, size, native, focal: float, cx: float, cy: float) -> Camera:
        down, across = size[0] / native[0], size[1] / native[1]
        return cls(size, focal * across, focal * down, cx * across - 0.5, cy * down - 0.5)

    def supersampled(self, down: int, across: int) -> Camera:
        """Returns this camera with ``down`` x ``across`` pixels for each one."""
        return dataclasses.replace(
            self,
            size=(self.size[0] * down, self.size[1] * across),
            fx=self.fx * across,
            fy=self.fy * down,
            cx=(self.cx + 0.5) * across - 0.5,
            cy=(self.cy + 0.5) * down - 0.5,
        )

    @property
    def matrix(self) -> np.ndarray:
        """Returns intrinsics, ``[3, 3]``."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])
