"""Poses in the plane."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_denkf.functional.angles import wrap_angles
from torch_denkf.functional.manifolds.series import half_versine, one_minus_sinc, series, sinc
from torch_denkf.functional.manifolds.space import Space

__all__ = ["SE2"]


@dataclass(frozen=True)
class SE2(Space):
    """A pose in the plane: point and tangent are (angle, x, y), in rad and in the unit of length.

    Example:
        >>> turned = torch.tensor([torch.pi / 2, 0.0, 0.0])
        >>> SE2().plus(turned, torch.tensor([0.0, 1.0, 0.0])).round(decimals=4) + 0.0  # ahead is along y now
        tensor([1.5708, 0.0000, 1.0000])
    """

    point_dim = tangent_dim = 3
    _angles = 1

    def compose(self, first, second):
        """The second pose, seen from the first one's axes."""
        return torch.cat(
            [wrap_angles(first[..., :1] + second[..., :1]), _turn(first, second[..., 1:]) + first[..., 1:]], -1
        )

    def inverse(self, point):
        """The pose that undoes it."""
        back = -point
        return torch.cat([back[..., :1], _turn(back, back[..., 1:])], -1)

    def exp(self, tangent):
        """Where a constant twist leads: an arc."""
        along, across = self._arc(tangent[..., :1])
        x, y = tangent[..., 1:2], tangent[..., 2:]
        return torch.cat([wrap_angles(tangent[..., :1]), along * x - across * y, across * x + along * y], -1)

    def log(self, point):
        """The twist that leads there."""
        angle = wrap_angles(point[..., :1])
        along, across = self._arc(angle)
        size = along.square() + across.square()
        x, y = point[..., 1:2], point[..., 2:]
        return torch.cat([angle, (along * x + across * y) / size, (along * y - across * x) / size], -1)

    def right_jacobian(self, tangent):
        """Solà et al., eq. 163, with the angle first."""
        angle, x, y = tangent.unbind(-1)
        along, across = (value.squeeze(-1) for value in self._arc(tangent[..., :1]))
        square = angle.square()
        third = angle * series(square, one_minus_sinc)  # (angle - sin angle) / angle^2
        half = series(square, half_versine)
        zero, one = torch.zeros_like(angle), torch.ones_like(angle)
        rows = [
            [one, zero, zero],
            [x * third - y * half, along, across],
            [y * third + x * half, -across, along],
        ]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def adjoint(self, point):
        """Solà et al., eq. 159, with the angle first."""
        angle, x, y = point.unbind(-1)
        cos, sin, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
        rows = [[one, zero, zero], [y, cos, -sin], [-x, sin, cos]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def basis(self, point):
        """A rotation of what leads ahead and to the left."""
        cos, sin = point[..., 0].cos(), point[..., 0].sin()
        zero, one = torch.zeros_like(cos), torch.ones_like(cos)
        rows = [[one, zero, zero], [zero, cos, -sin], [zero, sin, cos]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def dual_basis(self, point):
        """The rotation back."""
        return self.basis(point).mT

    def neutral(self, like=None):
        """Zeros."""
        return torch.zeros(3) if like is None else like.new_zeros(3)

    def normalise(self, point):
        """The angle, wrapped."""
        return torch.cat([wrap_angles(point[..., :1]), point[..., 1:]], -1)

    def _between(self, points, weights):
        angles, first = points[..., :1], points[..., :1, :1]
        return super()._between(torch.cat([first + wrap_angles(angles - first), points[..., 1:]], -1), weights)

    @staticmethod
    def _arc(angle: Tensor) -> tuple[Tensor, Tensor]:
        """sin(a) / a and (1 - cos(a)) / a."""
        square = angle.square()
        return series(square, sinc), angle * series(square, half_versine)


def _turn(pose: Tensor, vector: Tensor) -> Tensor:
    """A vector ``[*, 2]`` turned by the angle of a pose ``[*, 3]``."""
    cos, sin = pose[..., :1].cos(), pose[..., :1].sin()
    x, y = vector[..., :1], vector[..., 1:]
    return torch.cat([cos * x - sin * y, sin * x + cos * y], -1)
