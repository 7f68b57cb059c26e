"""Rotations in space, and vectors that they turn."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_denkf.functional.manifolds.matrices import blocks, eye
from torch_denkf.functional.manifolds.quaternions import (
    conjugate,
    products,
    quaternion_product,
    rotate,
    rotation_matrix,
    skew,
    unit,
)
from torch_denkf.functional.manifolds.series import (
    bend,
    cos_half,
    fifth,
    fourth,
    half_versine,
    inverse_third,
    one_minus_sinc,
    series,
    sinc_half,
)
from torch_denkf.functional.manifolds.space import Space

__all__ = ["SE3", "SE23", "SO3", "Turned"]

_NEAR = {torch.float32: 1e-2, torch.float64: 1e-4}  # tangents squared below which the arc tangent's series is as exact


class _RotationAndVectors(Space):
    """A rotation and K vectors that it turns; the point is (quaternion, vectors), the tangent (rotation, vectors)."""

    vectors: int
    _angles = 3

    @property
    def point_dim(self) -> int:  # type: ignore[override]
        """4 + 3 K."""
        return 4 + 3 * self.vectors

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """3 + 3 K."""
        return 3 + 3 * self.vectors

    def compose(self, first, second):
        """The second, seen from the first one's axes."""
        turn = unit(quaternion_product(first[..., :4], second[..., :4]))
        if not self.vectors:
            return turn
        moved = self._vectors(first, 4) + rotate(first[..., None, :4], self._vectors(second, 4))
        return torch.cat([turn, moved.flatten(-2)], -1)

    def inverse(self, point):
        """What undoes it."""
        back = conjugate(point[..., :4])
        if not self.vectors:
            return back
        return torch.cat([back, -rotate(back.unsqueeze(-2), self._vectors(point, 4)).flatten(-2)], -1)

    def exp(self, tangent):
        """Where a constant rate of all leads."""
        angles = tangent[..., :3]
        square = angles.square().sum(-1, keepdim=True)
        quaternion = torch.cat([series(square, cos_half), 0.5 * series(square, sinc_half) * angles], -1)
        return self._bent(quaternion, angles, tangent, series(square, half_versine), series(square, one_minus_sinc))

    def log(self, point):
        """The shorter rotation, and what leads to the vectors meanwhile."""
        quaternion = point[..., :4]
        quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
        w, axis = quaternion[..., :1], quaternion[..., 1:]
        size = axis.square().sum(-1, keepdim=True)
        small = size < _NEAR[size.dtype]
        length = torch.where(small, 1.0, size).sqrt()
        ratio = size / w.clamp_min(0.5).square()  # atan(t) / t in t^2, where it is small
        near = (2 / w.clamp_min(0.5)) * (1 - ratio / 3 + ratio.square() / 5 - ratio.pow(3) / 7 + ratio.pow(4) / 9)
        turns = torch.where(small, near, 2 * torch.atan2(length, w) / length) * axis
        third = series(turns.square().sum(-1, keepdim=True), inverse_third)
        return self._bent(turns, turns, point, torch.full_like(third, -0.5), third)

    def _bent(self, turn: Tensor, turns: Tensor, value: Tensor, half: Tensor, third: Tensor) -> Tensor:
        """A rotation, and what :func:`bend` makes of the vectors of a point or tangent."""
        if not self.vectors:
            return turn
        vectors = self._vectors(value, value.shape[-1] - 3 * self.vectors)
        bent = bend(turns.unsqueeze(-2), vectors, half.unsqueeze(-1), third.unsqueeze(-1))
        return torch.cat([turn, bent.flatten(-2)], -1)

    def right_jacobian(self, tangent):
        """Solà et al., eq. 143; Barfoot, eq. 7.86, of the negative tangent."""
        back = -tangent
        square = back[..., :3].square().sum(-1)[..., None, None]
        turn = skew(back[..., :3])
        turn2 = turn @ turn
        third = series(square, one_minus_sinc)
        block = eye(back[..., :3], 3) + series(square, half_versine) * turn + third * turn2
        if not self.vectors:
            return block
        move = skew(self._vectors(back, 3))
        turn, turn2, square, third = (value.unsqueeze(-3) for value in (turn, turn2, square, third))
        both = turn @ move
        around = both @ turn
        low = 0.5 * move + third * (both + move @ turn + around)
        low = low + series(square, fourth) * (turn @ both + move @ turn2 - 3 * around)
        low = low + series(square, fifth) * (around @ turn + turn @ around)
        return self._matrix(block, low)

    def adjoint(self, point):
        """Solà et al., eq. 175."""
        turn = rotation_matrix(point[..., :4])
        return self._matrix(turn, skew(self._vectors(point, 4)) @ turn.unsqueeze(-3)) if self.vectors else turn

    def _matrix(self, block: Tensor, low: Tensor) -> Tensor:
        """Of blocks ``[*, 3, 3]`` on the diagonal, and others ``[*, K, 3, 3]`` below the first."""
        first = torch.cat([block, low.flatten(-3, -2)], -2)
        others = eye(block[..., 0], self.vectors)[..., None, :, None] * block[..., None, :, None, :]
        others = others.flatten(-2).flatten(-3, -2)
        return torch.cat([first, torch.cat([torch.zeros_like(others[..., :3, :]), others], -2)], -1)

    def basis(self, point):
        """Half the quaternion's products with i, j and k; the rotation, once for each vector."""
        return blocks([products(point) / 2, *[rotation_matrix(point[..., :4])] * self.vectors])

    def dual_basis(self, point):
        """Its transpose, with twice the products."""
        return blocks([2 * products(point), *[rotation_matrix(point[..., :4])] * self.vectors]).mT

    def neutral(self, like=None):
        """No rotation, zeros."""
        zeros = torch.zeros(self.point_dim) if like is None else like.new_zeros(self.point_dim)
        return torch.cat([torch.ones_like(zeros[:1]), zeros[1:]])

    def normalise(self, point):
        """With a quaternion of length one."""
        return torch.cat([unit(point[..., :4]), point[..., 4:]], -1)

    def _between(self, points, weights):
        opposite = (points[..., :4] * points[..., :1, :4]).sum(-1, keepdim=True) < 0
        quaternions = torch.where(opposite, -points[..., :4], points[..., :4])
        return super()._between(torch.cat([quaternions, points[..., 4:]], -1), weights)

    def _vectors(self, value: Tensor, begin: int) -> Tensor:
        return value[..., begin:].unflatten(-1, (self.vectors, 3))


@dataclass(frozen=True)
class SO3(_RotationAndVectors):
    """A rotation: the point is a unit quaternion (w, x, y, z), the tangent an axis times an angle in rad.

    Example:
        >>> SO3().exp(torch.tensor([torch.pi / 2, 0.0, 0.0]))
        tensor([0.7071, 0.7071, 0.0000, 0.0000])
    """

    vectors = 0


@dataclass(frozen=True)
class SE3(_RotationAndVectors):
    """A pose: the point is (quaternion, position), the tangent (rotation, motion in the body's axes).

    Example:
        >>> half_turn = torch.tensor([0.0, 0.0, 0.0, 1.0, 5.0, 0.0, 0.0])  # around z
        >>> SE3().plus(half_turn, torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))[4:]
        tensor([4., 0., 0.])
    """

    vectors = 1


@dataclass(frozen=True)
class SE23(_RotationAndVectors):
    """Orientation, velocity and position: the point is (quaternion, velocity, position), the tangent has nine numbers.

    Example:
        >>> SE23().point_dim, SE23().tangent_dim
        (10, 9)
    """

    vectors = 2


@dataclass(frozen=True)
class Turned(_RotationAndVectors):
    """A rotation and K vectors that it turns, such as velocity, position and landmarks: SE_K(3).

    Args:
        vectors: K.

    Example:
        >>> Turned(4).point_dim, Turned(4).tangent_dim
        (16, 15)
    """

    vectors: int
