"""Functions of an angle that are 0 / 0 at none, by their series there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_SMALL = {torch.float32: 0.25, torch.float64: 1e-2}  # angles squared below which a series is as exact as the formula


@dataclass(frozen=True)
class Function:
    """An even function of an angle: by its formula, and by the first terms of its series in the angle squared."""

    formula: Callable[[Tensor], Tensor]
    terms: tuple[float, ...]


def series(square: Tensor, function: Function) -> Tensor:
    """The value at the angle whose square is given; value and gradient are finite at 0."""
    small = square < _SMALL[square.dtype]
    safe = torch.where(small, 1.0, square).sqrt()
    near = torch.zeros_like(square)
    for term in reversed(function.terms):
        near = near * square + term
    return torch.where(small, near, function.formula(safe))


cos_half = Function(lambda a: (a / 2).cos(), (1.0, -1 / 8, 1 / 384, -1 / 46080))
sinc_half = Function(lambda a: (a / 2).sin() / (a / 2), (1.0, -1 / 24, 1 / 1920, -1 / 322560))
sinc = Function(lambda a: a.sin() / a, (1.0, -1 / 6, 1 / 120, -1 / 5040))
half_versine = Function(lambda a: (1 - a.cos()) / a**2, (1 / 2, -1 / 24, 1 / 720, -1 / 40320))
one_minus_sinc = Function(lambda a: (a - a.sin()) / a**3, (1 / 6, -1 / 120, 1 / 5040, -1 / 362880))
fourth = Function(lambda a: (a**2 + 2 * a.cos() - 2) / (2 * a**4), (1 / 24, -1 / 720, 1 / 40320, -1 / 3628800))
fifth = Function(
    lambda a: (2 * a - 3 * a.sin() + a * a.cos()) / (2 * a**5),
    (1 / 120, -1 / 2520, 1 / 120960, -1 / 9979200),
)
inverse_third = Function(
    lambda a: (1 - a / 2 * (a / 2).cos() / (a / 2).sin()) / a**2,
    (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600),
)


def bend(turn: Tensor, vector: Tensor, half: Tensor, third: Tensor) -> Tensor:
    """The vector v + half w x v + third w x (w x v), with turn w."""
    turn, vector = torch.broadcast_tensors(turn, vector)
    once = torch.linalg.cross(turn, vector)
    return vector + half * once + third * torch.linalg.cross(turn, once)
