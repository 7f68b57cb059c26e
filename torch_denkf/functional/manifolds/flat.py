"""Lines and circles: plain numbers, some of which are angles."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_denkf._checks import check_count, check_number
from torch_denkf.functional.angles import wrap_angles
from torch_denkf.functional.manifolds.space import Space, eye

__all__ = ["Circle", "Euclidean", "Flat"]

_Parts = Callable[..., tuple[Tensor, ...]]
_RUNS = 4  # largest number of runs of angles and of other components for which splitting is faster than a mask


class Flat(Space):
    """N plain numbers, some of which may be angles in rad, in any order: lines and circles.

    Points and tangents both have N components. All formulas are closed: differences and sums are component-wise,
    with angles wrapped to [-pi, pi), and Jacobians are the identity.

    Args:
        size: N.
        circular: indices of the angles.

    Raises:
        TypeError: if an index is no whole number.
        ValueError: if an index is out of range.

    Example:
        >>> plane = Flat(3, circular=[2])  # x, y and a heading: Euclidean(2) * Circle()
        >>> plane.minus(torch.tensor([1.0, 0.0, 3.0]), torch.tensor([0.0, 0.0, -3.0]))
        tensor([ 1.0000,  0.0000, -0.2832])
    """

    def __init__(self, size: int, circular: Sequence[int] = ()):
        check_count("size", size, least=1)
        self.size = self.point_dim = self.tangent_dim = size
        self.circular = tuple(sorted({operator.index(component) for component in circular}))
        self._angles = len(self.circular)
        for component in self.circular:
            check_number("circular", component, least=0, below=size)
        turns = [index in self.circular for index in range(size)]  # no groupby, which torch.compile cannot trace
        ends = [index for index in range(1, size + 1) if index == size or turns[index] != turns[index - 1]]
        runs = zip((0, *ends[:-1]), ends, strict=True)  # consecutive: whether angles, and their number
        self._runs = tuple((turns[begin], end - begin) for begin, end in runs)

    def __repr__(self):
        return f"Flat(size={self.size}, circular={self.circular})"

    def __eq__(self, other):
        return isinstance(other, Flat) and (self.size, self.circular) == (other.size, other.circular)

    def __hash__(self):
        return hash((self.size, self.circular))

    @property
    def flat(self):
        """Returns this space."""
        return self

    @property
    def parts(self) -> tuple[Space, ...]:  # type: ignore[override]
        """Returns the lines, adjacent ones together, and each circle."""
        return tuple(
            part for turns, count in self._runs for part in ([Circle()] * count if turns else [Euclidean(count)])
        )

    def compose(self, first, second):
        """Returns the sum, angles wrapped."""
        return self.normalise(first + second)

    def inverse(self, point):
        """Returns the negative."""
        return -point

    def right_jacobian(self, tangent):
        """Returns the identity."""
        return eye(tangent, self.size)

    adjoint = basis = dual_basis = right_jacobian

    def neutral(self, like=None):
        """Returns zeros."""
        return torch.zeros(self.size) if like is None else like.new_zeros(self.size)

    def normalise(self, point):
        """Wraps the angles."""
        return self._apart(lambda angle: (wrap_angles(angle),), _same, point)[0]

    exp = log = normalise

    def plus(self, point, tangent):
        """Returns the sum, angles wrapped."""
        self.check(point=point, tangent=tangent)
        return self.normalise(point + tangent)

    def minus(self, point, origin):
        """Returns the difference, angles wrapped."""
        self.check(point=point, origin=origin)
        return self.normalise(point - origin)

    def mean(self, points, weights=None):
        """Returns the mean; for angles the circular direction plus the mean of the deviations from it."""

        def of_circles(values: Tensor) -> tuple[Tensor]:
            center = _direction(values, weights)
            return (wrap_angles(center + _mean(wrap_angles(values - center), weights)),)

        return self._apart(of_circles, lambda values: (_mean(values, weights),), points)[0].squeeze(-2)

    near = mean

    def innovation(self, reading, expected, observed=None):
        """Returns the difference, angles wrapped; NaN if the reading is NaN."""
        return self.minus(reading, expected)

    def align(self, predicted, reading, observed=None):
        """Moves angles to the same turn; plain numbers are unchanged.

        Predictions are moved to within half a turn of their circular mean, the reading's samples to within half a turn
        of their own, and their mean to within half a turn of the predictions'. See :meth:`Space.align`.

        Example:
            >>> predicted, reading = Circle().align(torch.tensor([[3.1], [-3.1]]), torch.tensor([-3.0]))
            >>> predicted.mean().round(decimals=2).abs(), (reading - predicted.mean()).round(decimals=2)
            (tensor(3.1400), tensor([0.1400]))
        """
        self.check(predicted=predicted, reading=reading)
        if not self.circular:
            return predicted, reading
        samples = reading if reading.ndim == predicted.ndim else reading.unsqueeze(-2)
        if observed is not None:
            samples = torch.where(observed.unsqueeze(-2), samples, 0)

        def of_circles(predicted: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
            center, own = _direction(predicted), _direction(samples)
            samples = center + wrap_angles(own - center) + wrap_angles(samples - own)
            return center + wrap_angles(predicted - center), samples

        predicted, samples = self._apart(of_circles, _same, predicted, samples)
        return predicted, samples if reading.ndim == predicted.ndim else samples.squeeze(-2)

    def _apart(self, of_circles: _Parts, of_lines: _Parts, *values: Tensor) -> tuple[Tensor, ...]:
        """Applies one function to the angles of values ``[*, N]``, and another to the other components."""
        if not self.circular:
            return of_lines(*values)
        if len(self.circular) == self.size:
            return of_circles(*values)
        if len(self._runs) > _RUNS:
            place = torch.arange(self.size, device=values[0].device)
            turns = sum(((place == index) for index in self.circular[1:]), place == self.circular[0])
            both = zip(of_circles(*values), of_lines(*values), strict=True)
            return tuple(torch.where(turns, circles, lines) for circles, lines in both)
        runs = zip(*(value.split([count for _, count in self._runs], -1) for value in values), strict=True)
        parts = [(of_circles if turns else of_lines)(*own) for (turns, _), own in zip(self._runs, runs, strict=True)]
        return tuple(torch.cat(own, -1) for own in zip(*parts, strict=True))

    def told(self, observed):
        """Returns the mask itself: components are masked one by one."""
        return observed, observed

    _whole = told


class Euclidean(Flat):
    """N plain numbers.

    Args:
        size: N.

    Example:
        >>> Euclidean(2).plus(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.0]))
        tensor([1.5000, 2.0000])
    """

    def __init__(self, size: int):
        super().__init__(size)

    def __repr__(self):
        return f"Euclidean(size={self.size})"


class Circle(Flat):
    """An angle in rad, in [-pi, pi).

    Example:
        >>> Circle().minus(torch.tensor([3.0]), torch.tensor([-3.0]))
        tensor([-0.2832])
    """

    def __init__(self):
        super().__init__(1, [0])

    def __repr__(self):
        return "Circle()"


def _same(*values: Tensor) -> tuple[Tensor, ...]:
    return values


def _mean(values: Tensor, weights: Tensor | None) -> Tensor:
    """Returns the mean ``[*B, 1, N]`` of values ``[*B, E, N]``."""
    return values.mean(-2, keepdim=True) if weights is None else (weights.unsqueeze(-1) * values).sum(-2, keepdim=True)


def _direction(turns: Tensor, weights: Tensor | None = None) -> Tensor:
    """Returns the direction of the sum of unit vectors, ``[*B, 1, N]``; detached, as it only selects the turn."""
    turns = turns.detach()
    return torch.atan2(_mean(turns.sin(), weights), _mean(turns.cos(), weights))
