"""Spaces made of others: side by side, many times, and with steps on the other side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.functional.manifolds.flat import Flat
from torch_denkf.functional.manifolds.space import Space, blocks, eye, side_by_side

__all__ = ["Opposite", "Place", "Product", "Repeated", "places_of", "whole_parts"]


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
        >>> from torch_denkf.functional.manifolds import SE3
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
    def parts(self) -> Sequence[Space]:  # type: ignore[override]
        """Those of the space, each with its steps on the other side."""
        return tuple(part.flat or Opposite(part) for part in self.part.parts)

    @property
    def _angles(self) -> int:  # type: ignore[override]
        return self.part._angles

    def compose(self, first, second):
        """The second, then the first."""
        return self.part.compose(self.part.normalise(second), first)  # a reading may be so to rounding alone

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
        >>> from torch_denkf.functional.manifolds import Euclidean, SO3
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

    @property
    def flat(self):
        """The parts side by side, where all are lines and circles."""
        return _joined(self.parts)

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
        return blocks([part.right_jacobian(own) for part, own in zip(self.parts, self.tangents(tangent), strict=True)])

    def exp_and_jacobian(self, tangent):
        """Part by part, and blocks on the diagonal."""
        pairs = [part.exp_and_jacobian(own) for part, own in zip(self.parts, self.tangents(tangent), strict=True)]
        points, jacobians = zip(*pairs, strict=True)
        return torch.cat(points, -1), blocks(jacobians)

    def adjoint(self, point):
        """Blocks on the diagonal."""
        return blocks([part.adjoint(own) for part, own in zip(self.parts, self.points(point), strict=True)])

    def basis(self, point):
        """Blocks on the diagonal."""
        return blocks([part.basis(own) for part, own in zip(self.parts, self.points(point), strict=True)])

    def dual_basis(self, point):
        """Blocks on the diagonal."""
        return blocks([part.dual_basis(own) for part, own in zip(self.parts, self.points(point), strict=True)])

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
        >>> from torch_denkf.functional.manifolds import SO3
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

    @property
    def parts(self) -> Sequence[Space]:  # type: ignore[override]
        """N times the same."""
        return (self.part,) * self.count

    @property
    def flat(self):
        """The parts side by side, where these are lines and circles."""
        return _joined(self.parts)

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
        return (eye(value, self.count)[..., None, :, None] * blocks.unsqueeze(-2)).flatten(-2).flatten(-3, -2)


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
        >>> from torch_denkf.functional.manifolds import Euclidean, SE3
        >>> [place.rotation for place in places_of(Product(Euclidean(2), SE3()))]
        [slice(0, 0, None), slice(2, 5, None)]
    """
    places, point, tangent = [], 0, 0
    todo = [space]
    while todo:
        part = todo.pop(0)
        if part.parts and tuple(part.parts) != (part,):
            todo = [*part.parts, *todo]
            continue
        ends = point + part.point_dim, tangent + part.tangent_dim
        turn = slice(tangent, tangent + part._angles)
        places.append(Place(part, slice(point, ends[0]), slice(tangent, ends[1]), turn))
        point, tangent = ends
    return places


def whole_parts(space: Space, known: Tensor) -> tuple[Tensor, Tensor]:
    """Marks the parts of which all is known: a rotation of which one number is missing is not, nor is its pose.

    Args:
        space: S.
        known: which numbers of points are known, ``[*, P]`` bool. Plain numbers are known one by one.

    Returns:
        The numbers of points that stand in whole parts, ``[*, P]``, and the tangents' numbers that can be told,
        ``[*, D]``.

    Example:
        >>> from torch_denkf.functional.manifolds import Euclidean, SO3
        >>> whole_parts(Product(SO3(), Euclidean(2)), torch.tensor([True, True, False, True, True, False]))[1]
        tensor([False, False, False,  True, False])
    """
    return side_by_side([place.space._whole(known[..., place.point]) for place in places_of(space)])


def _joined(parts: Sequence[Space]) -> Flat | None:
    """Spaces of lines and circles side by side; ``None`` where one is another."""
    circular, size = [], 0
    for part in parts:
        if part.flat is None:
            return None
        circular += [size + index for index in part.flat.circular]
        size += part.flat.size
    return Flat(size, circular)
