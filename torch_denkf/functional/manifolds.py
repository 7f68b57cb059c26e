r"""Spaces that states and readings live in: numbers, angles, rotations, motions, and products of them.

A *point* is how a state is stored. A *tangent* is a small step from a point, in as many numbers as the space has
directions; errors and covariances are in them. One convention holds everywhere but in :class:`Opposite`:

.. math:: x \oplus d = x \, \exp(d), \qquad x \ominus y = \log(y^{-1} x),

a step is applied on the right, in the axes of the point it starts from. So :math:`y \oplus (x \ominus y) = x`.

A rotation is a unit quaternion with w first, as MuJoCo stores it; it takes the body's axes to the world's. A quaternion
and its negative are the same rotation. Orientation stands first in points and in tangents.

Source: Solà, Deray & Atchuthan 2018, arXiv:1812.01537 (all but SE23); Barrau & Bonnabel 2017, IEEE T-AC 62 (SE23);
Barfoot 2017, State Estimation for Robotics, eq. 7.86 (the Jacobian's lower block).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf._checks import check_count
from torch_denkf.functional.angles import wrap_angles

__all__ = [
    "SE2",
    "SE3",
    "SE23",
    "SO3",
    "Circle",
    "Euclidean",
    "Product",
    "Space",
    "quaternion_of",
    "quaternion_product",
    "rotate",
    "rotation_matrix",
    "skew",
]

_SMALL = {torch.float32: 0.25, torch.float64: 1e-2}  # angles squared below which a series is as exact as the formula
_NEAR = {torch.float32: 1e-2, torch.float64: 1e-4}  # likewise, of the series of the arc tangent
_MEAN_STEPS = 3  # of Gauss-Newton, each of which takes at least the square of the spread off the error


class Space:
    """A space of points; the base of all.

    All spaces here are Lie groups. A subclass writes :meth:`compose`, :meth:`inverse`, :meth:`exp`, :meth:`log`,
    :meth:`right_jacobian`, :meth:`adjoint`, :meth:`basis`, :meth:`dual_basis` and :meth:`neutral`. Two spaces of one
    kind are equal.

    Attributes:
        point_dim: numbers of a point, P.
        tangent_dim: numbers of a tangent, D.
    """

    point_dim: int
    tangent_dim: int
    _angles = 0  # leading numbers of a tangent that are a rotation

    def compose(self, first: Tensor, second: Tensor) -> Tensor:
        """The product of two points ``[*, P]``."""
        raise NotImplementedError

    def inverse(self, point: Tensor) -> Tensor:
        """What takes a point ``[*, P]`` back to the neutral one."""
        raise NotImplementedError

    def exp(self, tangent: Tensor) -> Tensor:
        """Where a tangent ``[*, D]`` leads from the neutral point, ``[*, P]``."""
        raise NotImplementedError

    def log(self, point: Tensor) -> Tensor:
        """The shortest tangent ``[*, D]`` that leads from the neutral point to a point ``[*, P]``."""
        raise NotImplementedError

    def right_jacobian(self, tangent: Tensor) -> Tensor:
        r"""J with :math:`\exp(d + \delta) \approx \exp(d) \exp(J \delta)`: ``[*, D, D]`` of ``[*, D]``."""
        raise NotImplementedError

    def adjoint(self, point: Tensor) -> Tensor:
        r"""A with :math:`x \exp(d) x^{-1} = \exp(A d)`: ``[*, D, D]`` of ``[*, P]``."""
        raise NotImplementedError

    def basis(self, point: Tensor) -> Tensor:
        r"""B with :math:`x \oplus d \approx x + B d` for a small d: ``[*, P, D]`` of ``[*, P]``."""
        raise NotImplementedError

    def dual_basis(self, point: Tensor) -> Tensor:
        r"""B with :math:`(x + e) \ominus x \approx B e` for a small e: ``[*, D, P]`` of ``[*, P]``."""
        raise NotImplementedError

    def neutral(self, like: Tensor | None = None) -> Tensor:
        """The neutral point ``[P]``, of the precision and on the device of ``like``."""
        raise NotImplementedError

    def normalise(self, point: Tensor) -> Tensor:
        """The nearest point to numbers ``[*, P]`` that are one but for rounding, or that a network gave."""
        return point

    def plus(self, point: Tensor, tangent: Tensor) -> Tensor:
        """The point ``[*, P]`` that a tangent ``[*, D]`` leads to."""
        self.check(point=point)
        self.check(tangent=tangent)
        return self.compose(point, self.exp(tangent))

    def minus(self, point: Tensor, origin: Tensor) -> Tensor:
        """The shortest tangent ``[*, D]`` from ``origin`` to ``point``, both ``[*, P]``."""
        self.check(point=point)
        self.check(origin=origin)
        return self.log(self.compose(self.inverse(origin), point))

    def distance(self, point: Tensor, other: Tensor) -> Tensor:
        """The length ``[*]`` of the tangent between two points; of two rotations the angle between them, in rad."""
        return torch.linalg.vector_norm(self.minus(point, other), dim=-1)

    def mean(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """The point ``[*B, P]`` around which the tangents to points ``[*B, E, P]`` add up to zero.

        A few Gauss-Newton steps. It is unique where the points lie within a quarter turn of one of them.

        Args:
            points: ``[*B, E, P]``.
            weights: ``[*B, E]``, which add up to one; ``None`` for equal ones.
        """
        center = self.near(points, weights).unsqueeze(-2)
        for _ in range(_MEAN_STEPS):
            away = self.minus(points, center)
            step = away.mean(-2) if weights is None else (weights.unsqueeze(-1) * away).sum(-2)
            center = self.plus(center, step.unsqueeze(-2))
        return center.squeeze(-2)

    def near(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """A point ``[*B, P]`` near the mean, where any will do for tangents: the mean of the numbers."""
        return self.normalise(self._between(points, weights)).squeeze(-2)

    def _between(self, points: Tensor, weights: Tensor | None) -> Tensor:
        """A point ``[*B, 1, P]`` near the mean: the mean of the numbers, counted from the first point."""
        away = points - points[..., :1, :]
        away = away.mean(-2, keepdim=True) if weights is None else (weights.unsqueeze(-1) * away).sum(-2, keepdim=True)
        return points[..., :1, :] + away

    def _whole(self, known: Tensor) -> tuple[Tensor, Tensor]:
        """What :func:`whole_parts` says of a space that is no product."""
        known = known.all(-1, keepdim=True)
        return known.expand(*known.shape[:-1], self.point_dim), known.expand(*known.shape[:-1], self.tangent_dim)

    def perturb(self, point: Tensor, std: Tensor, noise: Tensor) -> Tensor:
        """A random point ``[*, P]``: standard normal ``noise`` ``[*, D]`` times standard deviations ``[*, D]`` away."""
        return self.plus(point, std * noise)

    def check(self, **values: Tensor) -> None:
        """Raises unless the last dimension of each value, ``tangent`` or any point, has the right size.

        Raises:
            ValueError: if it has not; names the value.
        """
        for name, value in values.items():
            due = self.tangent_dim if name == "tangent" else self.point_dim
            if value.shape[-1:] != (due,):
                kind = "tangent" if name == "tangent" else "point"
                raise ValueError(f"{name} has shape {list(value.shape)}; a {kind} of {self} is [*, {due}].")


@dataclass(frozen=True)
class Euclidean(Space):
    """N plain numbers.

    Args:
        size: N.

    Example:
        >>> Euclidean(2).plus(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.0]))
        tensor([1.5000, 2.0000])
    """

    size: int

    def __post_init__(self):
        check_count("size", self.size, least=1)

    @property
    def point_dim(self) -> int:  # type: ignore[override]
        """N."""
        return self.size

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """N."""
        return self.size

    def compose(self, first, second):
        """The sum."""
        return first + second

    def inverse(self, point):
        """The negative."""
        return -point

    def exp(self, tangent):
        """The same numbers."""
        return tangent

    def log(self, point):
        """The same numbers."""
        return point

    def right_jacobian(self, tangent):
        """The identity."""
        return _eye(tangent, self.size)

    def adjoint(self, point):
        """The identity."""
        return _eye(point, self.size)

    def basis(self, point):
        """The identity."""
        return _eye(point, self.size)

    def dual_basis(self, point):
        """The identity."""
        return _eye(point, self.size)

    def neutral(self, like=None):
        """Zeros."""
        return torch.zeros(self.size) if like is None else like.new_zeros(self.size)

    def mean(self, points, weights=None):
        """The mean."""
        return points.mean(-2) if weights is None else (weights.unsqueeze(-1) * points).sum(-2)

    def near(self, points, weights=None):
        """The mean."""
        return self.mean(points, weights)

    def _whole(self, known):
        return known, known


@dataclass(frozen=True)
class Circle(Space):
    """An angle in rad, in [-pi, pi).

    Example:
        >>> Circle().minus(torch.tensor([3.0]), torch.tensor([-3.0]))
        tensor([-0.2832])
    """

    point_dim = tangent_dim = _angles = 1

    def compose(self, first, second):
        """The sum, wrapped."""
        return wrap_angles(first + second)

    def inverse(self, point):
        """The negative."""
        return -point

    def exp(self, tangent):
        """The angle, wrapped."""
        return wrap_angles(tangent)

    def log(self, point):
        """The angle, wrapped."""
        return wrap_angles(point)

    def right_jacobian(self, tangent):
        """One."""
        return _eye(tangent, 1)

    def adjoint(self, point):
        """One."""
        return _eye(point, 1)

    def basis(self, point):
        """One."""
        return _eye(point, 1)

    def dual_basis(self, point):
        """One."""
        return _eye(point, 1)

    def neutral(self, like=None):
        """Zero."""
        return torch.zeros(1) if like is None else like.new_zeros(1)

    def normalise(self, point):
        """The angle, wrapped."""
        return wrap_angles(point)

    def _between(self, points, weights):
        first = points[..., :1, :]
        return super()._between(first + wrap_angles(points - first), weights)


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
        third = angle * _series(square, _one_minus_sinc)  # (angle - sin angle) / angle^2
        half = _series(square, _half_versine)
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
        return _series(square, _sinc), angle * _series(square, _half_versine)


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
        turn = _unit(quaternion_product(first[..., :4], second[..., :4]))
        if not self.vectors:
            return turn
        moved = self._vectors(first, 4) + rotate(first[..., None, :4], self._vectors(second, 4))
        return torch.cat([turn, moved.flatten(-2)], -1)

    def inverse(self, point):
        """What undoes it."""
        back = _conjugate(point[..., :4])
        if not self.vectors:
            return back
        return torch.cat([back, -rotate(back.unsqueeze(-2), self._vectors(point, 4)).flatten(-2)], -1)

    def exp(self, tangent):
        """Where a constant rate of all leads."""
        angles = tangent[..., :3]
        square = angles.square().sum(-1, keepdim=True)
        quaternion = torch.cat([_series(square, _cos_half), 0.5 * _series(square, _sinc_half) * angles], -1)
        return self._bent(quaternion, angles, tangent, _series(square, _half_versine), _series(square, _one_minus_sinc))

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
        angles = torch.where(small, near, 2 * torch.atan2(length, w) / length) * axis
        third = _series(angles.square().sum(-1, keepdim=True), _inverse_third)
        return self._bent(angles, angles, point, torch.full_like(third, -0.5), third)

    def _bent(self, turn: Tensor, angles: Tensor, value: Tensor, half: Tensor, third: Tensor) -> Tensor:
        """A rotation, and what :func:`_bend` makes of the vectors of a point or tangent."""
        if not self.vectors:
            return turn
        vectors = self._vectors(value, value.shape[-1] - 3 * self.vectors)
        bent = _bend(angles.unsqueeze(-2), vectors, half.unsqueeze(-1), third.unsqueeze(-1))
        return torch.cat([turn, bent.flatten(-2)], -1)

    def right_jacobian(self, tangent):
        """Solà et al., eq. 143; Barfoot, eq. 7.86, of the negative tangent."""
        back = -tangent
        square = back[..., :3].square().sum(-1)[..., None, None]
        turn = skew(back[..., :3])
        turn2 = turn @ turn
        third = _series(square, _one_minus_sinc)
        block = _eye(back[..., :3], 3) + _series(square, _half_versine) * turn + third * turn2
        if not self.vectors:
            return block
        move = skew(self._vectors(back, 3))
        turn, turn2, square, third = (value.unsqueeze(-3) for value in (turn, turn2, square, third))
        both = turn @ move
        around = both @ turn
        low = 0.5 * move + third * (both + move @ turn + around)
        low = low + _series(square, _fourth) * (turn @ both + move @ turn2 - 3 * around)
        low = low + _series(square, _fifth) * (around @ turn + turn @ around)
        return self._matrix(block, low)

    def adjoint(self, point):
        """Solà et al., eq. 175."""
        turn = rotation_matrix(point[..., :4])
        return self._matrix(turn, skew(self._vectors(point, 4)) @ turn.unsqueeze(-3)) if self.vectors else turn

    def _matrix(self, block: Tensor, low: Tensor) -> Tensor:
        """Of blocks ``[*, 3, 3]`` on the diagonal, and others ``[*, K, 3, 3]`` below the first."""
        first = torch.cat([block, low.flatten(-3, -2)], -2)
        others = _eye(block[..., 0], self.vectors)[..., None, :, None] * block[..., None, :, None, :]
        others = others.flatten(-2).flatten(-3, -2)
        return torch.cat([first, torch.cat([torch.zeros_like(others[..., :3, :]), others], -2)], -1)

    def basis(self, point):
        """Half the quaternion's products with i, j and k; the rotation, once for each vector."""
        return _blocks([_products(point) / 2, *[rotation_matrix(point[..., :4])] * self.vectors])

    def dual_basis(self, point):
        """Its transpose, with twice the products."""
        return _blocks([2 * _products(point), *[rotation_matrix(point[..., :4])] * self.vectors]).mT

    def neutral(self, like=None):
        """No rotation, zeros."""
        zeros = torch.zeros(self.point_dim) if like is None else like.new_zeros(self.point_dim)
        return torch.cat([torch.ones_like(zeros[:1]), zeros[1:]])

    def normalise(self, point):
        """With a quaternion of length one."""
        return torch.cat([_unit(point[..., :4]), point[..., 4:]], -1)

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


@dataclass(frozen=True)
class Opposite(Space):
    r"""A space whose steps are applied on the left: :math:`x \oplus d = \exp(d) \, x`, in the world's axes.

    An extended Kalman filter on it is a right-invariant one. It is the same group with its products the other way
    round.

    Args:
        part: the space.

    Source:
        Barrau & Bonnabel 2017, IEEE T-AC 62.

    Example:
        >>> turned = torch.tensor([0.0, 0.0, 0.0, 1.0, 5.0, 0.0, 0.0])  # half a turn around z
        >>> Opposite(SE3()).plus(turned, torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))[4:]
        tensor([6., 0., 0.])
    """

    part: Space

    @property
    def point_dim(self) -> int:  # type: ignore[override]
        """P."""
        return self.part.point_dim

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """D."""
        return self.part.tangent_dim

    @property
    def _angles(self) -> int:  # type: ignore[override]
        return self.part._angles

    def compose(self, first, second):
        """The second, then the first."""
        return self.part.compose(second, first)

    def inverse(self, point):
        """That of the space."""
        return self.part.inverse(point)

    def exp(self, tangent):
        """That of the space."""
        return self.part.exp(tangent)

    def log(self, point):
        """That of the space."""
        return self.part.log(point)

    def right_jacobian(self, tangent):
        """The left one of the space."""
        return self.part.right_jacobian(-tangent)

    def adjoint(self, point):
        """The inverse of the space's: it takes errors in the world's axes to the body's."""
        return self.part.adjoint(self.part.inverse(point))

    def basis(self, point):
        """That of the space, of the step as the body sees it."""
        return self.part.basis(point) @ self.adjoint(point)

    def dual_basis(self, point):
        """That of the space, as the world sees it."""
        return self.part.adjoint(point) @ self.part.dual_basis(point)

    def neutral(self, like=None):
        """That of the space."""
        return self.part.neutral(like)

    def normalise(self, point):
        """That of the space."""
        return self.part.normalise(point)

    def near(self, points, weights=None):
        """That of the space."""
        return self.part.near(points, weights)


@dataclass(frozen=True)
class Product(Space):
    """Several spaces side by side: points and tangents are those of the parts, one behind the other.

    Args:
        *parts: spaces.

    Example:
        >>> state = Product(SO3(), Euclidean(3))  # an orientation, and a gyro's bias
        >>> state.point_dim, state.tangent_dim
        (7, 6)
    """

    parts: tuple[Space, ...]
    point_dim: int = field(init=False, repr=False, compare=False)
    tangent_dim: int = field(init=False, repr=False, compare=False)

    def __init__(self, *parts: Space):
        if not parts or not all(isinstance(part, Space) for part in parts):
            raise TypeError(f"Product takes spaces, such as SO3() and Euclidean(3); got {list(parts)}.")
        object.__setattr__(self, "parts", parts)
        object.__setattr__(self, "point_dim", sum(part.point_dim for part in parts))
        object.__setattr__(self, "tangent_dim", sum(part.tangent_dim for part in parts))

    def compose(self, first, second):
        """Part by part."""
        return self._each(lambda part, *both: part.compose(*both), self.points(first), self.points(second))

    def inverse(self, point):
        """Part by part."""
        return self._each(lambda part, own: part.inverse(own), self.points(point))

    def exp(self, tangent):
        """Part by part."""
        return self._each(lambda part, own: part.exp(own), self.tangents(tangent))

    def log(self, point):
        """Part by part."""
        return self._each(lambda part, own: part.log(own), self.points(point))

    def right_jacobian(self, tangent):
        """Blocks on the diagonal."""
        return _blocks([part.right_jacobian(own) for part, own in zip(self.parts, self.tangents(tangent), strict=True)])

    def adjoint(self, point):
        """Blocks on the diagonal."""
        return _blocks([part.adjoint(own) for part, own in zip(self.parts, self.points(point), strict=True)])

    def basis(self, point):
        """Blocks on the diagonal."""
        return _blocks([part.basis(own) for part, own in zip(self.parts, self.points(point), strict=True)])

    def dual_basis(self, point):
        """Blocks on the diagonal."""
        return _blocks([part.dual_basis(own) for part, own in zip(self.parts, self.points(point), strict=True)])

    def neutral(self, like=None):
        """Part by part."""
        return torch.cat([part.neutral(like) for part in self.parts])

    def normalise(self, point):
        """Part by part."""
        return self._each(lambda part, own: part.normalise(own), self.points(point))

    def mean(self, points, weights=None):
        """Part by part."""
        return self._each(lambda part, own: part.mean(own, weights), self.points(points))

    def near(self, points, weights=None):
        """Part by part."""
        return self._each(lambda part, own: part.near(own, weights), self.points(points))

    def points(self, point: Tensor) -> Sequence[Tensor]:
        """The parts of a point."""
        return point.split([part.point_dim for part in self.parts], -1)

    def tangents(self, tangent: Tensor) -> Sequence[Tensor]:
        """The parts of a tangent."""
        return tangent.split([part.tangent_dim for part in self.parts], -1)

    def _each(self, function: Callable[..., Tensor], *values: Sequence[Tensor]) -> Tensor:
        return torch.cat([function(*own) for own in zip(self.parts, *values, strict=True)], -1)


@dataclass(frozen=True)
class Repeated(Space):
    """N points of one space side by side: ``Product(space, space, ...)``, worked out for all at once.

    Args:
        part: the space.
        count: N.

    Example:
        >>> Repeated(SO3(), 4).point_dim, Repeated(SO3(), 4).tangent_dim
        (16, 12)
    """

    part: Space
    count: int

    @property
    def point_dim(self) -> int:  # type: ignore[override]
        """N P."""
        return self.count * self.part.point_dim

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """N D."""
        return self.count * self.part.tangent_dim

    def compose(self, first, second):
        """Point by point."""
        return self._each(self.part.compose, first, second)

    def inverse(self, point):
        """Point by point."""
        return self._each(self.part.inverse, point)

    def exp(self, tangent):
        """Point by point."""
        return self._each(self.part.exp, tangent)

    def log(self, point):
        """Point by point."""
        return self._each(self.part.log, point)

    def right_jacobian(self, tangent):
        """Blocks on the diagonal."""
        return self._diagonal(self.part.right_jacobian, tangent)

    def adjoint(self, point):
        """Blocks on the diagonal."""
        return self._diagonal(self.part.adjoint, point)

    def basis(self, point):
        """Blocks on the diagonal."""
        return self._diagonal(self.part.basis, point)

    def dual_basis(self, point):
        """Blocks on the diagonal."""
        return self._diagonal(self.part.dual_basis, point)

    def neutral(self, like=None):
        """N times the same."""
        return self.part.neutral(like).repeat(self.count)

    def normalise(self, point):
        """Point by point."""
        return self._each(self.part.normalise, point)

    def near(self, points, weights=None):
        """Point by point."""
        apart = points.unflatten(-1, (self.count, -1)).movedim(-2, -3)
        return self.part.near(apart, None if weights is None else weights.unsqueeze(-2)).flatten(-2)

    def _each(self, function: Callable[..., Tensor], *values: Tensor) -> Tensor:
        return function(*(value.unflatten(-1, (self.count, -1)) for value in values)).flatten(-2)

    def _diagonal(self, function: Callable[[Tensor], Tensor], value: Tensor) -> Tensor:
        blocks = function(value.unflatten(-1, (self.count, -1)))
        return (_eye(value, self.count)[..., None, :, None] * blocks.unsqueeze(-2)).flatten(-2).flatten(-3, -2)


class Place(NamedTuple):
    """A part of a product, and where it stands.

    Attributes:
        space: the part.
        point: its numbers among those of a point.
        tangent: its numbers among those of a tangent.
        rotation: those of the tangent that are a rotation, an angle or an axis times an angle; they may be none.
    """

    space: Space
    point: slice
    tangent: slice
    rotation: slice


def places_of(space: Space) -> list[Place]:
    """The parts of a product, and of products within it; a space that is none is its own part.

    Example:
        >>> [place.rotation for place in places_of(Product(Euclidean(2), SE3()))]
        [slice(0, 0, None), slice(2, 5, None)]
    """
    places, point, tangent = [], 0, 0
    todo = [space]
    while todo:
        part = todo.pop(0)
        if isinstance(part, Product):
            todo = [*part.parts, *todo]
            continue
        ends = point + part.point_dim, tangent + part.tangent_dim
        turn = slice(tangent, tangent + part._angles)
        places.append(Place(part, slice(point, ends[0]), slice(tangent, ends[1]), turn))
        point, tangent = ends
    return places


def whole_parts(space: Space, known: Tensor) -> tuple[Tensor, Tensor]:
    """Of which parts all is known: a rotation of which one number is missing is not, nor is its pose.

    Args:
        space: S.
        known: which numbers of points are known, ``[*, P]`` bool. Plain numbers are known one by one.

    Returns:
        The numbers of points that stand in whole parts, ``[*, P]``, and the tangents' numbers that can be told,
        ``[*, D]``.

    Example:
        >>> whole_parts(Product(SO3(), Euclidean(2)), torch.tensor([True, True, False, True, True, False]))[1]
        tensor([False, False, False,  True, False])
    """
    points, tangents = [], []
    for place in places_of(space):
        whole, told = place.space._whole(known[..., place.point])
        points.append(whole)
        tangents.append(told)
    return torch.cat(points, -1), torch.cat(tangents, -1)


def check_space(space: Space | None, angles: Sequence[int] = ()) -> None:
    """Raises unless this is a space, and angles are not named beside it; or it is ``None``.

    Raises:
        TypeError: for what is no space.
        ValueError: for angles beside it.
    """
    if space is None:
        return
    if not isinstance(space, Space):
        raise TypeError(f"space must be one, such as Product(SO3(), Euclidean(3)); got {space!r}"[:200])
    if len(angles):
        raise ValueError(
            f"angles={list(angles)} are components of plain numbers, but space={space} says itself which of its are "
            "angles; pass one of the two."
        )


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """The rotation ``second``, then ``first``: both quaternions ``[*, 4]``, w first."""
    a, b = first[..., :1], first[..., 1:]
    c, d = second[..., :1], second[..., 1:]
    w = a * c - (b * d).sum(-1, keepdim=True)
    return torch.cat([w, a * d + c * b + torch.linalg.cross(*torch.broadcast_tensors(b, d))], -1)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """A vector ``[*, 3]`` in the body's axes, turned into the world's by a quaternion ``[*, 4]``."""
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    axis, vector = torch.broadcast_tensors(axis, vector)
    twice = 2 * torch.linalg.cross(axis, vector)
    return vector + w * twice + torch.linalg.cross(axis, twice)


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """The matrix ``[*, 3, 3]`` of a quaternion ``[*, 4]``: its columns are the body's axes in the world's."""
    return torch.stack([rotate(quaternion, axis) for axis in torch.eye(3).to(quaternion)], -1)


def quaternion_of(matrix: Tensor) -> Tensor:
    """A quaternion ``[*, 4]`` of a rotation matrix ``[*, 3, 3]``, by the largest of its four numbers."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    candidates = [
        torch.stack([1 + a + e + i, h - f, c - g, d - b], -1),
        torch.stack([h - f, 1 + a - e - i, b + d, c + g], -1),
        torch.stack([c - g, b + d, 1 - a + e - i, f + h], -1),
        torch.stack([d - b, c + g, f + h, 1 - a - e + i], -1),
    ]
    table = torch.stack(candidates, -2)  # each row is 4 q_k q
    best = table.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = table.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    return _unit(row)


def skew(vector: Tensor) -> Tensor:
    """The matrix ``[*, 3, 3]`` whose product with another vector is the cross product with it."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _products(point: Tensor) -> Tensor:
    """The products of a point's quaternion with i, j and k, ``[*, 4, 3]``."""
    w, x, y, z = point[..., :4].unbind(-1)
    rows = [[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _conjugate(quaternion: Tensor) -> Tensor:
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], -1)


def _unit(quaternion: Tensor) -> Tensor:
    return quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)


def _turn(pose: Tensor, vector: Tensor) -> Tensor:
    """A vector ``[*, 2]`` turned by the angle of a pose ``[*, 3]``."""
    cos, sin = pose[..., :1].cos(), pose[..., :1].sin()
    x, y = vector[..., :1], vector[..., 1:]
    return torch.cat([cos * x - sin * y, sin * x + cos * y], -1)


def _bend(angles: Tensor, vector: Tensor, half: Tensor, third: Tensor) -> Tensor:
    """The vector v + half w x v + third w x (w x v), with angles w."""
    angles, vector = torch.broadcast_tensors(angles, vector)
    once = torch.linalg.cross(angles, vector)
    return vector + half * once + third * torch.linalg.cross(angles, once)


def _eye(like: Tensor, size: int) -> Tensor:
    return torch.eye(size, dtype=like.dtype, device=like.device).expand(*like.shape[:-1], size, size)


def _blocks(parts: Sequence[Tensor]) -> Tensor:
    """Matrices on the diagonal of one."""
    sizes = [part.shape[-1] for part in parts]
    rows = []
    for place, part in enumerate(parts):
        batch = part.shape[:-1]
        before, after = part.new_zeros(*batch, sum(sizes[:place])), part.new_zeros(*batch, sum(sizes[place + 1 :]))
        rows.append(torch.cat([before, part, after], -1))
    return torch.cat(rows, -2)


@dataclass(frozen=True)
class _Function:
    """An even function of an angle: by its formula, and by the first terms of its series in the angle squared."""

    formula: Callable[[Tensor], Tensor]
    terms: tuple[float, ...]


def _series(square: Tensor, function: _Function) -> Tensor:
    """The value at the angle whose square is given; value and gradient are finite at 0."""
    small = square < _SMALL[square.dtype]
    safe = torch.where(small, 1.0, square).sqrt()
    near = torch.zeros_like(square)
    for term in reversed(function.terms):
        near = near * square + term
    return torch.where(small, near, function.formula(safe))


_cos_half = _Function(lambda a: (a / 2).cos(), (1.0, -1 / 8, 1 / 384, -1 / 46080))
_sinc_half = _Function(lambda a: (a / 2).sin() / (a / 2), (1.0, -1 / 24, 1 / 1920, -1 / 322560))
_sinc = _Function(lambda a: a.sin() / a, (1.0, -1 / 6, 1 / 120, -1 / 5040))
_half_versine = _Function(lambda a: (1 - a.cos()) / a**2, (1 / 2, -1 / 24, 1 / 720, -1 / 40320))
_one_minus_sinc = _Function(lambda a: (a - a.sin()) / a**3, (1 / 6, -1 / 120, 1 / 5040, -1 / 362880))
_fourth = _Function(lambda a: (a**2 + 2 * a.cos() - 2) / (2 * a**4), (1 / 24, -1 / 720, 1 / 40320, -1 / 3628800))
_fifth = _Function(
    lambda a: (2 * a - 3 * a.sin() + a * a.cos()) / (2 * a**5),
    (1 / 120, -1 / 2520, 1 / 120960, -1 / 9979200),
)
_inverse_third = _Function(
    lambda a: (1 - a / 2 * (a / 2).cos() / (a / 2).sin()) / a**2,
    (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600),
)
