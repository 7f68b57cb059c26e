"""A stereo camera: where its corners lie in space, and where points appear in its images."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["StereoCamera"]


@dataclass(frozen=True)
class StereoCamera:
    """A rectified stereo camera. Its axes: x to the right, y down, z ahead, from the left lens.

    A corner is (u left, v left, disparity) in pixels here, ``[*, 3]``. The lens may be left with a little distortion:
    an image's radius is too large by the factor ``1 + radial[0] r^2 + radial[1] r^4``, with r the distance from the
    centre over the focal length.

    Attributes:
        focal: focal length in pixels.
        center: where the optical axis meets the images, (u, v) in pixels.
        baseline: distance of the lenses in m.
        radial: what the rectification has left of the distortion.
        disparity_offset: in pixels, what corners' disparities are short of.
    """

    focal: float
    center: tuple[float, float]
    baseline: float
    radial: tuple[float, float] = (0.0, 0.0)
    disparity_offset: float = 0.0

    def corners(self, pixels: Tensor) -> Tensor:
        """Corners ``[*, 3]`` of what a tracker gives, ``[*, 4]``: u left, v left, u right, v right."""
        left, right = self._undistorted(pixels[..., :2]), self._undistorted(pixels[..., 2:])
        disparity = left[..., :1] - right[..., :1] + self.disparity_offset
        return torch.cat([left, disparity], -1)

    def points(self, corners: Tensor) -> Tensor:
        """Points ``[*, 3]`` in m of corners ``[*, 3]``."""
        center = torch.tensor([*self.center, 0.0]).to(corners)
        away = corners[..., :2] - center[:2]
        return torch.cat([away, torch.full_like(away[..., :1], self.focal)], -1) * self.baseline / corners[..., 2:]

    def project(self, points: Tensor) -> Tensor:
        """Corners ``[*, 3]`` of points ``[*, 3]`` ahead of the camera."""
        seen = torch.cat([points[..., :2], torch.full_like(points[..., :1], self.baseline)], -1)
        return self.focal * seen / points[..., 2:] + torch.tensor([*self.center, 0.0]).to(points)

    def jacobian(self, points: Tensor) -> Tensor:
        """Of :meth:`project`, ``[*, 3, 3]``."""
        over = self.focal / points[..., 2]
        x, y = points[..., 0] * over / points[..., 2], points[..., 1] * over / points[..., 2]
        zero, depth = torch.zeros_like(over), over * self.baseline / points[..., 2]
        rows = [[over, zero, -x], [zero, over, -y], [zero, zero, -depth]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def jacobian_of_points(self, corners: Tensor) -> Tensor:
        """Of :meth:`points`, ``[*, 3, 3]``."""
        points = self.points(corners)
        over = self.baseline / corners[..., 2]
        zero = torch.zeros_like(over)
        columns = [torch.stack(column, -1) for column in ([over, zero, zero], [zero, over, zero])]
        return torch.stack([*columns, -points / corners[..., 2:]], -1)

    def _undistorted(self, pixels: Tensor) -> Tensor:
        center = torch.tensor(self.center).to(pixels)
        away = (pixels - center) / self.focal
        square = away.square().sum(-1, keepdim=True)
        factor = 1 - self.radial[0] * square - self.radial[1] * square.square()
        return center + self.focal * away * factor
