"""Stereo camera: triangulation of corners and projection of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_denkf._checks import check_number

__all__ = ["StereoCamera"]


@dataclass(frozen=True)
class StereoCamera:
    """A rectified stereo camera. Its axes: x to the right, y down, z ahead, from the left lens.

    A corner is (u left, v left, disparity) in pixels, ``[*, 3]``. Residual errors of the rectification can be
    corrected. Below, x and y are the normalised image coordinates of a corner, and r^2 = x^2 + y^2.

    Attributes:
        focal: focal length in pixels.
        center: principal point (u, v) in pixels.
        baseline: distance of the lenses in m.
        radial: residual radial distortion, by the factor ``1 + radial[0] + radial[1] r^2 + radial[2] r^4``.
        disparity_offset: correction of the disparity in pixels: coefficients of 1, x, y, x^2, xy, y^2 and r^4, or the
            first of these.

    Raises:
        ValueError: if a number is not finite, ``focal`` or ``baseline`` is not positive, or a tuple has the wrong
            length.
    """

    focal: float
    center: tuple[float, float]
    baseline: float
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    disparity_offset: tuple[float, ...] = (0.0,)

    def __post_init__(self):
        check_number("focal", self.focal, above=0, cure="It is in pixels")
        check_number("baseline", self.baseline, above=0, most=100, cure="It is in m")
        for name, counts in (("center", [2]), ("radial", [3]), ("disparity_offset", range(1, 8))):
            numbers = getattr(self, name)
            if isinstance(numbers, str) or not isinstance(numbers, Sequence) or len(numbers) not in counts:
                raise ValueError(f"{name} must be {' or '.join(map(str, counts))} numbers; got {numbers!r}")
            for number in numbers:
                check_number(f"each number of {name}", number)

    def corners(self, pixels: Tensor) -> Tensor:
        """Returns corners ``[*, 3]`` of tracked pixels ``[*, 4]``: u left, v left, u right, v right."""
        left, right = self._undistorted(pixels[..., :2]), self._undistorted(pixels[..., 2:])
        x, y = ((pixels[..., :2] - torch.tensor(self.center).to(pixels)) / self.focal).unbind(-1)
        powers = [torch.ones_like(x), x, y, x.square(), x * y, y.square(), (x.square() + y.square()).square()]
        short = sum(number * power for number, power in zip(self.disparity_offset, powers, strict=False))
        disparity = left[..., 0] - right[..., 0] + short
        return torch.cat([left, disparity.unsqueeze(-1)], -1)

    def points(self, corners: Tensor) -> Tensor:
        """Returns points ``[*, 3]`` in m of corners ``[*, 3]``."""
        center = torch.tensor([*self.center, 0.0]).to(corners)
        away = corners[..., :2] - center[:2]
        return torch.cat([away, torch.full_like(away[..., :1], self.focal)], -1) * self.baseline / corners[..., 2:]

    def project(self, points: Tensor) -> Tensor:
        """Returns corners ``[*, 3]`` of points ``[*, 3]`` ahead of the camera."""
        seen = torch.cat([points[..., :2], torch.full_like(points[..., :1], self.baseline)], -1)
        return self.focal * seen / points[..., 2:] + torch.tensor([*self.center, 0.0]).to(points)

    def jacobian(self, points: Tensor) -> Tensor:
        """Returns the Jacobian of :meth:`project`, ``[*, 3, 3]``."""
        over = self.focal / points[..., 2]
        x, y = points[..., 0] * over / points[..., 2], points[..., 1] * over / points[..., 2]
        zero, depth = torch.zeros_like(over), over * self.baseline / points[..., 2]
        rows = [[over, zero, -x], [zero, over, -y], [zero, zero, -depth]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def jacobian_of_points(self, corners: Tensor) -> Tensor:
        """Returns the Jacobian of :meth:`points`, ``[*, 3, 3]``."""
        points = self.points(corners)
        over = self.baseline / corners[..., 2]
        zero = torch.zeros_like(over)
        columns = [torch.stack(column, -1) for column in ([over, zero, zero], [zero, over, zero])]
        return torch.stack([*columns, -points / corners[..., 2:]], -1)

    def _undistorted(self, pixels: Tensor) -> Tensor:
        center = torch.tensor(self.center).to(pixels)
        away = (pixels - center) / self.focal
        square = away.square().sum(-1, keepdim=True)
        factor = 1 - self.radial[0] - self.radial[1] * square - self.radial[2] * square.square()
        return center + self.focal * away * factor
