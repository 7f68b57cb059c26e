"""Rotations in the plane and in space, alone and with vectors that they rotate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_denkf.functional.angles import wrap_angles
from torch_denkf.functional.kernels.small_system import made_once
from torch_denkf.functional.manifolds.quaternions import (
    BENT,
    conjugate,
    products,
    quaternion_product,
    rotate,
    rotation_matrix,
    skew,
    unit,
)
from torch_denkf.functional.manifolds.space import Space, blocks, eye, side_by_side

__all__ = ["SE2", "SE3", "SE23", "SO3", "Turned"]

_SMALL = {torch.float32: 0.25, torch.float64: 1e-2}  # squared angles below which a series is as exact as the formula
_NEAR = {torch.float32: 1e-2, torch.float64: 1e-4}  # squared sines below which the arc tangent's series is as exact


def _one_by_one(self: Space, known: Tensor) -> tuple[Tensor, Tensor]:
    """Narrows a mask of tangents: the rotation, and each vector, counts as observed only as a whole."""
    turn, size = known[..., : self._angles].all(-1, keepdim=True), 2 if self._angles == 1 else 3
    vectors = known[..., self._angles :].unflatten(-1, ((self.tangent_dim - self._angles) // size, size))
    vectors = vectors.all(-1).repeat_interleave(size, -1)
    turns = [turn.repeat_interleave(count, -1) for count in (self.point_dim - vectors.shape[-1], self._angles)]
    return side_by_side([(turns[0], turns[1]), (vectors, vectors)])


@dataclass(frozen=True)
class SE2(Space):
    """A pose in the plane: point and tangent are (angle, x, y), in rad and in the unit of length.

    Example:
        >>> turned = torch.tensor([torch.pi / 2, 0.0, 0.0])
        >>> SE2().plus(turned, torch.tensor([0.0, 1.0, 0.0])).round(decimals=4) + 0.0  # forward is along y
        tensor([1.5708, 0.0000, 1.0000])
    """

    point_dim = tangent_dim = 3
    _angles = 1
    _told = _one_by_one

    def compose(self, first, second):
        """Composes two poses: the second one is given in the first one's axes."""
        return torch.cat(
            [wrap_angles(first[..., :1] + second[..., :1]), _turn(first, second[..., 1:]) + first[..., 1:]], -1
        )

    def inverse(self, point):
        """Returns the inverse pose."""
        back = -point
        return torch.cat([back[..., :1], _turn(back, back[..., 1:])], -1)

    def exp(self, tangent):
        """Maps a constant twist to the pose at the end of its arc."""
        along, across = self._arc(tangent[..., :1])
        x, y = tangent[..., 1:2], tangent[..., 2:]
        return torch.cat([wrap_angles(tangent[..., :1]), along * x - across * y, across * x + along * y], -1)

    def log(self, point):
        """Returns the constant twist from the neutral pose to a point."""
        angle = wrap_angles(point[..., :1])
        along, across = self._arc(angle)
        size = along.square() + across.square()
        x, y = point[..., 1:2], point[..., 2:]
        return torch.cat([angle, (along * x + across * y) / size, (along * y - across * x) / size], -1)

    def right_jacobian(self, tangent):
        """Returns the matrix of Solà et al., eq. 163, with the angle first."""
        angle, x, y = tangent.unbind(-1)
        along, across = (value.squeeze(-1) for value in self._arc(tangent[..., :1]))
        square = angle.square()
        third = angle * series(square, one_minus_sinc)  # (angle - sin angle) / angle^2
        half = series(square, half_versine)
        zero, one = torch.zeros_like(angle), torch.ones_like(angle)
        rows = [[one, zero, zero], [x * third - y * half, along, across], [y * third + x * half, -across, along]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def adjoint(self, point):
        """Returns the matrix of Solà et al., eq. 159, with the angle first."""
        angle, x, y = point.unbind(-1)
        cos, sin, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
        rows = [[one, zero, zero], [y, cos, -sin], [-x, sin, cos]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def basis(self, point):
        """Returns the rotation of the forward and left directions."""
        cos, sin = point[..., 0].cos(), point[..., 0].sin()
        zero, one = torch.zeros_like(cos), torch.ones_like(cos)
        rows = [[one, zero, zero], [zero, cos, -sin], [zero, sin, cos]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def dual_basis(self, point):
        """Returns the inverse rotation of :meth:`basis`."""
        return self.basis(point).mT

    def neutral(self, like=None):
        """Returns zeros."""
        return torch.zeros(3) if like is None else like.new_zeros(3)

    def normalise(self, point):
        """Wraps the angle."""
        return torch.cat([wrap_angles(point[..., :1]), point[..., 1:]], -1)

    def _between(self, points, weights):
        angles, first = points[..., :1], points[..., :1, :1]
        return super()._between(torch.cat([first + wrap_angles(angles - first), points[..., 1:]], -1), weights)

    @staticmethod
    def _arc(angle: Tensor) -> tuple[Tensor, Tensor]:
        """Returns sin(a) / a and (1 - cos(a)) / a."""
        square = angle.square()
        return series(square, sinc), angle * series(square, half_versine)


class _RotationAndVectors(Space):
    """A rotation and K rotated vectors; the point is (quaternion, vectors), the tangent (rotation, vectors)."""

    vectors: int
    _angles = 3
    _told = _one_by_one

    @property
    def point_dim(self) -> int:  # type: ignore[override]
        """Returns 4 + 3 K."""
        return 4 + 3 * self.vectors

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """Returns 3 + 3 K."""
        return 3 + 3 * self.vectors

    def compose(self, first, second):
        """Composes two points: the second one is given in the first one's axes."""
        turn = unit(quaternion_product(first, second[..., :4]))
        if not self.vectors:
            return turn
        moved = self._vectors(first, 4) + rotate(first[..., None, :4], self._vectors(second, 4))
        return torch.cat([turn, moved.flatten(-2)], -1)

    def inverse(self, point):
        """Returns the inverse."""
        back = conjugate(point[..., :4])
        if not self.vectors:
            return back
        return torch.cat([back, -rotate(back.unsqueeze(-2), self._vectors(point, 4)).flatten(-2)], -1)

    def exp(self, tangent):
        """Maps a tangent, taken as constant rates, to the point that it leads to."""
        angles = tangent[..., :3]
        square = angles.square().sum(-1, keepdim=True)
        w, share, *bends = several(square, *_EXP[: 4 if self.vectors else 2])
        quaternion = torch.cat([w, share * angles], -1)
        return self._bent(quaternion, angles, tangent, *bends) if self.vectors else quaternion

    def log(self, point):
        """Returns the shorter rotation, and the constant rates of the vectors that lead to the point."""
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
        """Returns a rotation together with the :func:`bend` of the vectors of a point or tangent."""
        if not self.vectors:
            return turn
        vectors = self._vectors(value, value.shape[-1] - 3 * self.vectors)
        bent = bend(turns.unsqueeze(-2), vectors, half.unsqueeze(-1), third.unsqueeze(-1))
        return torch.cat([turn, bent.flatten(-2)], -1)

    def right_jacobian(self, tangent):
        """Returns the matrix of Solà et al., eq. 143; Barfoot, eq. 7.86, for the negative tangent."""
        angles, functions = tangent[..., :3], (half_versine, one_minus_sinc, fourth, fifth)
        found = several(angles.square().sum(-1, keepdim=True), *functions[: 4 if self.vectors else 2])
        half, third, *lower = (value.unsqueeze(-1) for value in found)
        turn, unit = skew(angles), eye(angles, 3)
        turn2 = turn @ turn
        block = torch.addcmul(torch.addcmul(unit, half, turn, value=-1), third, turn2)
        if not self.vectors:
            return block
        # Products of the skew matrices of w and v are written with w v^T.
        (fall, low), vectors = lower, self._vectors(tangent, 3)
        turns = angles.unsqueeze(-2).expand_as(vectors)
        again = torch.linalg.cross(turns, torch.linalg.cross(turns, vectors))
        outer, along = vectors.unsqueeze(-1) * turns.unsqueeze(-2), (turns * vectors).sum(-1)[..., None, None]
        shared = third * (turn - 2 * unit) - fall * turn - 2 * low * turn2
        low = skew(-0.5 * vectors - fall * again) + third.unsqueeze(-3) * (outer + outer.mT)
        return self._matrix(block, torch.addcmul(low, along, shared.unsqueeze(-3)))

    def exp_and_jacobian(self, tangent):
        """Returns point and Jacobian; without vectors they are computed from three functions of the angle."""
        if self.vectors:
            return super().exp_and_jacobian(tangent)
        square = tangent.square().sum(-1, keepdim=True)
        w, share, third = several(square, cos_half, half_sinc_half, one_minus_sinc, formula=_of_half)
        turn = torch.cat([w, share * tangent], -1)
        bent = torch.unflatten(BENT(2 * share * turn), -1, (3, 3))  # sin a and 1 - cos a from a / 2
        return turn, torch.addcmul(bent, (third * tangent).unsqueeze(-1), tangent.unsqueeze(-2))

    def adjoint(self, point):
        """Returns the matrix of Solà et al., eq. 175."""
        turn = rotation_matrix(point[..., :4])
        return self._matrix(turn, skew(self._vectors(point, 4)) @ turn.unsqueeze(-3)) if self.vectors else turn

    def _matrix(self, block: Tensor, low: Tensor) -> Tensor:
        """Assembles a matrix with blocks ``[*, 3, 3]`` on the diagonal, and ``[*, K, 3, 3]`` below the first."""
        first = torch.cat([block, low.flatten(-3, -2)], -2)
        others = eye(block[..., 0], self.vectors)[..., None, :, None] * block[..., None, :, None, :]
        others = others.flatten(-2).flatten(-3, -2)
        return torch.cat([first, torch.cat([torch.zeros_like(others[..., :3, :]), others], -2)], -1)

    def basis(self, point):
        """Returns block-diagonal half products of the quaternion with i, j and k, and the rotation for each vector."""
        return blocks([products(point) / 2, *[rotation_matrix(point[..., :4])] * self.vectors])

    def dual_basis(self, point):
        """Returns the transpose of :meth:`basis`, with twice the products instead of half."""
        return blocks([2 * products(point), *[rotation_matrix(point[..., :4])] * self.vectors]).mT

    def neutral(self, like=None):
        """Returns the identity rotation and zero vectors."""
        zeros = torch.zeros(self.point_dim) if like is None else like.new_zeros(self.point_dim)
        return torch.cat([torch.ones_like(zeros[:1]), zeros[1:]])

    def normalise(self, point):
        """Scales the quaternion to length one."""
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
    """Orientation, velocity and position: the point is (quaternion, velocity, position), the tangent has 9 components.

    Example:
        >>> SE23().point_dim, SE23().tangent_dim
        (10, 9)
    """

    vectors = 2


@dataclass(frozen=True)
class Turned(_RotationAndVectors):
    """A rotation and K vectors that it rotates, such as velocity, position and landmarks: SE_K(3).

    Args:
        vectors: K.

    Example:
        >>> Turned(4).point_dim, Turned(4).tangent_dim
        (16, 15)
    """

    vectors: int


def _turn(pose: Tensor, vector: Tensor) -> Tensor:
    """Rotates a vector ``[*, 2]`` by the angle of a pose ``[*, 3]``."""
    cos, sin = pose[..., :1].cos(), pose[..., :1].sin()
    x, y = vector[..., :1], vector[..., 1:]
    return torch.cat([cos * x - sin * y, sin * x + cos * y], -1)


@dataclass(frozen=True)
class Function:
    """An even function of an angle: its formula, and the first terms of its series in the squared angle."""

    formula: Callable[[Tensor], Tensor]
    terms: tuple[float, ...]


def series(square: Tensor, function: Function) -> Tensor:
    """Evaluates a function of an angle, given the square of the angle; value and gradient are finite at 0."""
    small = square < _SMALL[square.dtype]
    safe = torch.where(small, 1.0, square).sqrt()
    near = torch.zeros_like(square)
    for term in reversed(function.terms):
        near = near * square + term
    return torch.where(small, near, function.formula(safe))


def several(square: Tensor, *functions: Function, formula: Callable | None = None) -> Sequence[Tensor]:
    """Returns the :func:`series` of several functions of squares ``[*, 1]``, in fewer calls.

    Args:
        square: squared angles.
        functions: the functions.
        formula: computes all functions together, if they share terms.
    """
    if torch.compiler.is_compiling():
        return [series(square, function) for function in functions]
    dtype, device = square.dtype, square.device
    key = ("series", *map(id, functions), dtype, device)
    terms = [list(each) for each in zip(*(function.terms[::-1] for function in functions), strict=True)]
    first, *others = made_once(key, lambda: torch.as_tensor(terms, dtype=dtype, device=device)).unbind()
    small = square < _SMALL[dtype]
    safe, near = square.clamp_min(_SMALL[dtype]).sqrt(), first
    for each in others:
        near = torch.addcmul(each, near, square)
    exact = [each.formula(safe) for each in functions] if formula is None else formula(safe)
    return torch.where(small, near, torch.cat(exact, -1)).split_with_sizes([1] * len(exact), -1)


def _of_half(angle: Tensor) -> Sequence[Tensor]:
    """Returns the three functions of the exponential from sine and cosine of half the angle."""
    half = 0.5 * angle
    w, share = half.cos(), half.sin() / angle
    return w, share, torch.rsub(w * share, 1, alpha=2) / angle.square()


cos_half = Function(lambda a: (a / 2).cos(), (1.0, -1 / 8, 1 / 384, -1 / 46080))
half_sinc_half = Function(lambda a: (a / 2).sin() / a, (1 / 2, -1 / 48, 1 / 3840, -1 / 645120))
sinc = Function(lambda a: a.sin() / a, (1.0, -1 / 6, 1 / 120, -1 / 5040))
half_versine = Function(lambda a: (1 - a.cos()) / a**2, (1 / 2, -1 / 24, 1 / 720, -1 / 40320))
one_minus_sinc = Function(lambda a: (a - a.sin()) / a**3, (1 / 6, -1 / 120, 1 / 5040, -1 / 362880))
fourth = Function(lambda a: (a**2 + 2 * a.cos() - 2) / (2 * a**4), (1 / 24, -1 / 720, 1 / 40320, -1 / 3628800))
fifth = Function(
    lambda a: (2 * a - 3 * a.sin() + a * a.cos()) / (2 * a**5), (1 / 120, -1 / 2520, 1 / 120960, -1 / 9979200)
)
inverse_third = Function(
    lambda a: (1 - a / 2 * (a / 2).cos() / (a / 2).sin()) / a**2, (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600)
)

#: The functions in the exponential of a rotation, followed by those for the vectors.
_EXP = (cos_half, half_sinc_half, half_versine, one_minus_sinc)


def bend(turn: Tensor, vector: Tensor, half: Tensor, third: Tensor) -> Tensor:
    """Returns the vector v + half w x v + third w x (w x v), with turn w."""
    turn, vector = torch.broadcast_tensors(turn, vector)
    once = torch.linalg.cross(turn, vector)
    return vector + half * once + third * torch.linalg.cross(turn, once)
