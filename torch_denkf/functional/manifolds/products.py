"""Spaces made of others: products, repetitions, and spaces with steps applied on the left."""

from __future__ import annotations

from collections.abc import Sequence
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

    An extended Kalman filter on it is a right-invariant one. It is the same group with products in reverse order.

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
        """Returns P."""
        return self.part.point_dim

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """Returns D."""
        return self.part.tangent_dim

    @property
    def parts(self) -> Sequence[Space]:  # type: ignore[override]
        """Returns the parts of the space, each with steps on the left."""
        return tuple(part.flat or Opposite(part) for part in self.part.parts)

    @property
    def _angles(self) -> int:  # type: ignore[override]
        return self.part._angles

    def compose(self, first, second):
        """Composes in reverse order: the second, then the first."""
        return self.part.compose(self.part.normalise(second), first)  # a reading may be a point only up to rounding

    def inverse(self, point):
        """Returns the inverse in the space."""
        return self.part.inverse(point)

    def exp(self, tangent):
        """Returns the exponential in the space."""
        return self.part.exp(tangent)

    def log(self, point):
        """Returns the logarithm in the space."""
        return self.part.log(point)

    def right_jacobian(self, tangent):
        """Returns the left Jacobian of the space."""
        return self.part.right_jacobian(-tangent)

    def adjoint(self, point):
        """Returns the inverse adjoint of the space, which takes errors from the world's axes to the body's."""
        return self.part.adjoint(self.part.inverse(point))

    def basis(self, point):
        """Returns the basis of the space, for a step in the world's axes."""
        return self.part.basis(point) @ self.adjoint(point)

    def dual_basis(self, point):
        """Returns the dual basis of the space, with the step in the world's axes."""
        return self.part.adjoint(point) @ self.part.dual_basis(point)

    def neutral(self, like=None):
        """Returns the neutral point of the space."""
        return self.part.neutral(like)

    def normalise(self, point):
        """Normalises a point of the space."""
        return self.part.normalise(point)

    def near(self, points, weights=None):
        """Returns a point near the mean in the space."""
        return self.part.near(points, weights)


class _Made(Space):
    """Base of spaces made of others, whose methods work on each part."""

    @property
    def flat(self):
        """Returns the parts joined to one flat space; ``None`` if a part is not flat."""
        circular, size = [], 0
        for part in self.parts:
            if part.flat is None:
                return None
            circular += [size + index for index in part.flat.circular]
            size += part.flat.size
        return Flat(size, circular)

    def compose(self, first, second):
        """Composes each part."""
        return self._each("compose", first, second)

    def inverse(self, point):
        """Returns the inverse of each part."""
        return self._each("inverse", point)

    def exp(self, tangent):
        """Maps the tangent of each part to a point."""
        return self._each("exp", tangent)

    def log(self, point):
        """Maps the point of each part to a tangent."""
        return self._each("log", point)

    def normalise(self, point):
        """Normalises each part."""
        return self._each("normalise", point)

    def right_jacobian(self, tangent):
        """Returns the block-diagonal matrix of the parts' Jacobians."""
        return self._diagonal("right_jacobian", tangent)

    def adjoint(self, point):
        """Returns the block-diagonal matrix of the parts' adjoints."""
        return self._diagonal("adjoint", point)

    def basis(self, point):
        """Returns the block-diagonal matrix of the parts' bases."""
        return self._diagonal("basis", point)

    def dual_basis(self, point):
        """Returns the block-diagonal matrix of the parts' dual bases."""
        return self._diagonal("dual_basis", point)

    def _each(self, name: str, *values: Tensor) -> Tensor:
        """Applies a method of each part to the part's components, and concatenates the results."""
        raise NotImplementedError

    def _diagonal(self, name: str, value: Tensor) -> Tensor:
        """Applies a method of each part to the part's components, and returns block-diagonal matrices."""
        raise NotImplementedError


@dataclass(frozen=True)
class Product(_Made):
    """Product of several spaces: points and tangents are those of the parts, concatenated.

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

    def exp_and_jacobian(self, tangent):
        """Returns the points of the parts, concatenated, and their Jacobians, block-diagonal."""
        pairs = [part.exp_and_jacobian(own) for part, own in zip(self.parts, self._apart("exp", tangent), strict=True)]
        points, jacobians = zip(*pairs, strict=True)
        return torch.cat(points, -1), blocks(jacobians)

    def neutral(self, like=None):
        """Returns the neutral points of the parts, concatenated."""
        return torch.cat([part.neutral(like) for part in self.parts])

    def mean(self, points, weights=None):
        """Returns the mean of each part."""
        return self._each("mean", points, weights=weights)

    def near(self, points, weights=None):
        """Returns a point near the mean of each part."""
        return self._each("near", points, weights=weights)

    def points(self, point: Tensor) -> Sequence[Tensor]:
        """Returns the components of each part."""
        return point.split_with_sizes([part.point_dim for part in self.parts], -1)

    def _apart(self, name: str, value: Tensor) -> Sequence[Tensor]:
        if name not in ("exp", "right_jacobian"):
            return self.points(value)
        return value.split_with_sizes([part.tangent_dim for part in self.parts], -1)

    def _each(self, name, *values, **options):
        apart = zip(self.parts, *(self._apart(name, value) for value in values), strict=True)
        return torch.cat([getattr(part, name)(*own, **options) for part, *own in apart], -1)

    def _diagonal(self, name, value):
        apart = zip(self.parts, self._apart(name, value), strict=True)
        return blocks([getattr(part, name)(own) for part, own in apart])


@dataclass(frozen=True)
class Repeated(_Made):
    """N points of one space: ``Product(space, space, ...)``, computed for all at once.

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
        """Returns N P."""
        return self.count * self.part.point_dim

    @property
    def tangent_dim(self) -> int:  # type: ignore[override]
        """Returns N D."""
        return self.count * self.part.tangent_dim

    @property
    def parts(self) -> Sequence[Space]:  # type: ignore[override]
        """Returns the space N times."""
        return (self.part,) * self.count

    def neutral(self, like=None):
        """Returns its neutral point N times."""
        return self.part.neutral(like).repeat(self.count)

    def near(self, points, weights=None):
        """Returns a point near the mean for each of the N points."""
        apart = points.unflatten(-1, (self.count, -1)).movedim(-2, -3)
        return self.part.near(apart, None if weights is None else weights.unsqueeze(-2)).flatten(-2)

    def _each(self, name, *values):
        return getattr(self.part, name)(*(value.unflatten(-1, (self.count, -1)) for value in values)).flatten(-2)

    def _diagonal(self, name, value):
        blocks = getattr(self.part, name)(value.unflatten(-1, (self.count, -1)))
        return (eye(value, self.count)[..., None, :, None] * blocks.unsqueeze(-2)).flatten(-2).flatten(-3, -2)


class Place(NamedTuple):
    """A part of a product, and its position.

    Attributes:
        space: the part.
        point: its components of a point.
        tangent: its components of a tangent.
        rotation: the tangent components that are a rotation, an angle or an axis times an angle; possibly none.
    """

    space: Space
    point: slice
    tangent: slice
    rotation: slice


def places_of(space: Space) -> list[Place]:
    """Returns the parts of a product, and of products within it; another space is its own only part.

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
    """Marks the parts that are known completely: one unknown component makes a rotation, and its pose, unknown.

    Args:
        space: the space.
        known: known components of points, ``[*, P]`` bool. Plain numbers are known one by one.

    Returns:
        Components of points in completely known parts, ``[*, P]``, and the known components of tangents,
        ``[*, D]``.

    Example:
        >>> from torch_denkf.functional.manifolds import Euclidean, SO3
        >>> whole_parts(Product(SO3(), Euclidean(2)), torch.tensor([True, True, False, True, True, False]))[1]
        tensor([False, False, False,  True, False])
    """
    return side_by_side([place.space._whole(known[..., place.point]) for place in places_of(space)])
