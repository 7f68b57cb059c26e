"""Base class of all spaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import pad

if TYPE_CHECKING:
    from torch_denkf.functional.manifolds.flat import Flat
    from torch_denkf.functional.manifolds.products import Product

__all__ = ["Space", "check_space", "is_flat"]

_MEAN_STEPS = 3  # Gauss-Newton steps; each multiplies the error by about the square of the spread


class Space:
    """A space of points; the base class of all spaces.

    All spaces here are Lie groups. A subclass implements :meth:`compose`, :meth:`inverse`, :meth:`exp`, :meth:`log`,
    :meth:`right_jacobian`, :meth:`adjoint`, :meth:`basis`, :meth:`dual_basis` and :meth:`neutral`. Spaces of one
    kind are equal.

    Attributes:
        point_dim: number of components of a point, P.
        tangent_dim: number of components of a tangent, D.
    """

    point_dim: int
    tangent_dim: int
    parts: Sequence[Space] = ()  # the spaces of a product
    _angles = 0  # leading components of a tangent that are a rotation

    @property
    def flat(self) -> Flat | None:
        """Returns the space as lines and circles in closed form; ``None`` if it has other parts."""
        return None

    def __mul__(self, other: Space) -> Product:
        """Returns the product of both spaces; the components of ``other`` come last."""
        from torch_denkf.functional.manifolds.products import Product

        if not isinstance(other, Space):
            return NotImplemented
        return Product(*(part for one in (self, other) for part in (one.parts if isinstance(one, Product) else [one])))

    def compose(self, first: Tensor, second: Tensor) -> Tensor:
        """Returns the group product of two points ``[*, P]``."""
        raise NotImplementedError

    def inverse(self, point: Tensor) -> Tensor:
        """Returns the inverse of a point ``[*, P]``; their product is the neutral point."""
        raise NotImplementedError

    def exp(self, tangent: Tensor) -> Tensor:
        """Maps a tangent ``[*, D]`` at the neutral point to a point ``[*, P]``."""
        raise NotImplementedError

    def log(self, point: Tensor) -> Tensor:
        """Returns the shortest tangent ``[*, D]`` from the neutral point to a point ``[*, P]``."""
        raise NotImplementedError

    def right_jacobian(self, tangent: Tensor) -> Tensor:
        r"""Returns J with :math:`\exp(d + \delta) \approx \exp(d) \exp(J \delta)`: ``[*, D, D]`` of ``[*, D]``."""
        raise NotImplementedError

    def exp_and_jacobian(self, tangent: Tensor) -> tuple[Tensor, Tensor]:
        """Returns :meth:`exp` and :meth:`right_jacobian`, which may share computations."""
        return self.exp(tangent), self.right_jacobian(tangent)

    def adjoint(self, point: Tensor) -> Tensor:
        r"""Returns A with :math:`x \exp(d) x^{-1} = \exp(A d)`: ``[*, D, D]`` of ``[*, P]``."""
        raise NotImplementedError

    def basis(self, point: Tensor) -> Tensor:
        r"""Returns B with :math:`x \oplus d \approx x + B d` for a small d: ``[*, P, D]`` of ``[*, P]``."""
        raise NotImplementedError

    def dual_basis(self, point: Tensor) -> Tensor:
        r"""Returns B with :math:`(x + e) \ominus x \approx B e` for a small e: ``[*, D, P]`` of ``[*, P]``."""
        raise NotImplementedError

    def neutral(self, like: Tensor | None = None) -> Tensor:
        """Returns the neutral point ``[P]``, of the precision and on the device of ``like``."""
        raise NotImplementedError

    def normalise(self, point: Tensor) -> Tensor:
        """Returns the nearest point to values ``[*, P]`` with rounding errors, or from a network."""
        return point

    def plus(self, point: Tensor, tangent: Tensor) -> Tensor:
        """Returns the point ``[*, P]`` at the end of a tangent ``[*, D]`` from ``point``."""
        self.check(point=point, tangent=tangent)
        return self.compose(point, self.exp(tangent))

    def minus(self, point: Tensor, origin: Tensor) -> Tensor:
        """Returns the shortest tangent ``[*, D]`` from ``origin`` to ``point``, both ``[*, P]``."""
        self.check(point=point, origin=origin)
        return self.log(self.compose(self.inverse(origin), point))

    def distance(self, point: Tensor, other: Tensor) -> Tensor:
        """Returns the length ``[*]`` of the tangent between points; for rotations the angle between them, in rad."""
        return torch.linalg.vector_norm(self.minus(point, other), dim=-1)

    def mean(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """Returns the point ``[*B, P]`` at which the tangents to points ``[*B, E, P]`` add up to zero.

        It takes a few Gauss-Newton steps. The mean is unique if all points are within a quarter turn of one of them.

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
        """Returns a point ``[*B, P]`` near the mean, to which tangents can be taken: the mean of the components."""
        return self.normalise(self._between(points, weights)).squeeze(-2)

    def _between(self, points: Tensor, weights: Tensor | None) -> Tensor:
        """Returns a point ``[*B, 1, P]`` near the mean: the first point plus the mean difference from it."""
        away = points - points[..., :1, :]
        away = away.mean(-2, keepdim=True) if weights is None else (weights.unsqueeze(-1) * away).sum(-2, keepdim=True)
        return points[..., :1, :] + away

    def innovation(self, reading: Tensor, expected: Tensor, observed: Tensor | None = None) -> Tensor:
        """Returns the shortest tangent ``[*, D]`` from an expected reading to the actual one, both ``[*, P]``.

        Where a mask ``[*, 1]`` or ``[*, D]`` marks the reading as missing (see :meth:`told`), the expected reading
        replaces it, so that zeros or NaN there affect neither values nor gradients.
        """
        self.check(reading=reading, expected=expected)
        if observed is not None:
            reading = torch.where(self.told(observed)[0], reading, expected)
        return self.minus(*torch.broadcast_tensors(reading, expected))

    def told(self, observed: Tensor) -> tuple[Tensor, Tensor]:
        """Narrows a mask ``[*, D]`` to whole rotations and vectors, since the components of one are coupled.

        Returns:
            The mask of a point's components ``[*, P]``, and of a tangent's ``[*, D]``. A mask ``[*, 1]`` is unchanged.
        """
        if observed.shape[-1] == 1:
            return observed, observed
        self.check(observed=observed)
        if not self.parts:
            return self._told(observed)
        apart = observed.split([part.tangent_dim for part in self.parts], -1)
        return side_by_side([part.told(own) for part, own in zip(self.parts, apart, strict=True)])

    def align(self, predicted: Tensor, reading: Tensor, observed: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Maps predictions and a reading to plain numbers, which can be averaged and subtracted.

        The results are tangents at a point near the predictions' mean.

        Args:
            predicted: predicted readings of the members, ``[*B, E, P]``.
            reading: a point ``[*B, P]``, or samples ``[*B, E, P]``.
            observed: mask ``[*B, 1]`` or ``[*B, D]``; missing components may be NaN.

        Returns:
            Tangents ``[*B, E, D]``, and ``[*B, D]`` or ``[*B, E, D]``.
        """
        center = self.near(predicted)
        expected, mask = center.unsqueeze(-2), None if observed is None else observed.unsqueeze(-2)
        if reading.ndim < predicted.ndim:
            return self.innovation(predicted, expected, mask), self.innovation(reading, center, observed)
        return self.innovation(predicted, expected, mask), self.innovation(reading, expected, mask)

    def _whole(self, known: Tensor) -> tuple[Tensor, Tensor]:
        """Returns :func:`whole_parts` for a space that is no product."""
        known = known.all(-1, keepdim=True)
        return known.expand(*known.shape[:-1], self.point_dim), known.expand(*known.shape[:-1], self.tangent_dim)

    _told = _whole  # for a mask of tangents

    def perturb(self, point: Tensor, std: Tensor, noise: Tensor) -> Tensor:
        """Returns a random point ``[*, P]``: ``point`` plus standard normal ``noise`` ``[*, D]`` times ``std``."""
        return self.plus(point, std * noise)

    def check(self, **values: Tensor) -> None:
        """Raises unless the last dimension of each value has the right size, and no point is boolean.

        Args:
            **values: tangents under the names ``tangent`` and ``observed`` (a mask), points under any other.

        Raises:
            ValueError: if a value fails; the message names it.
        """
        for name, value in values.items():
            kind = "tangent" if name in ("tangent", "observed") else "point"
            due = self.tangent_dim if kind == "tangent" else self.point_dim
            flags = " of flags" if value.dtype == torch.bool and name != "observed" else ""
            if flags or value.shape[-1:] != (due,):
                raise ValueError(f"{name} has shape {list(value.shape)}{flags}; a {kind} of {self} is [*, {due}].")


def check_space(name: str, space: Space | None, *, flat: bool = False) -> Space | None:
    """Returns the space; a product of lines and circles as one :class:`Flat`.

    Args:
        name: the argument's name, for the message.
        space: a space; ``None`` for plain numbers.
        flat: whether only lines and circles are allowed.

    Raises:
        TypeError: if it is no space.
        ValueError: with ``flat``, for a space with other parts than lines and circles.

    Example:
        >>> from torch_denkf.functional.manifolds import Circle, Euclidean
        >>> check_space("space", Euclidean(2) * Circle())
        Flat(size=3, circular=(2,))
    """
    if space is None:
        return None
    if not isinstance(space, Space):
        raise TypeError(f"{name} is a Space, such as SO3() or Product(SE2(), Euclidean(2)); got {space!r}"[:200])
    if flat and space.flat is None:
        raise ValueError(f"{name} must be made of numbers and angles, such as Euclidean(2) * Circle(); got {space}.")
    return space.flat or space


def is_flat(*spaces: Space | None) -> bool:
    """Tells whether the formulas of plain numbers hold: each space is ``None``, or has lines and circles only."""
    return all(space is None or space.flat is not None for space in spaces)


def eye(like: Tensor, size: int) -> Tensor:
    """Returns the identity ``[*, size, size]`` for points ``[*, N]``."""
    return torch.eye(size, dtype=like.dtype, device=like.device).expand(*like.shape[:-1], size, size)


def side_by_side(parts: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Joins masks of the points and tangents of parts."""
    points, tangents = zip(*parts, strict=True)
    return torch.cat(points, -1), torch.cat(tangents, -1)


def blocks(parts: Sequence[Tensor]) -> Tensor:
    """Returns a block-diagonal matrix."""
    sizes = [part.shape[-1] for part in parts]
    return torch.cat([pad(part, (sum(sizes[:at]), sum(sizes[at + 1 :]))) for at, part in enumerate(parts)], -2)
