"""Beliefs and readings on a space: as tangents at a mean, where they are plain numbers."""

from __future__ import annotations

from torch import Tensor

from torch_denkf.functional import ensemble_var
from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.weighted import weighted_var

__all__ = ["mean_and_tangents", "mean_reading", "moments_on"]


def mean_reading(space: Space | None, samples: Tensor) -> Tensor:
    """Returns the mean ``[*B, Q]`` of samples of a reading ``[*B, E, Q]``."""
    return samples.mean(-2) if space is None else space.mean(samples)


def moments_on(space: Space, ensemble: Tensor, log_weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The mean ``[*B, P]`` of members ``[*B, E, P]``, and the variances ``[*B, D]`` of the tangents from it to them."""
    mean = space.mean(ensemble, None if log_weights is None else log_weights.exp())
    away = space.minus(ensemble, mean.unsqueeze(-2))
    return mean, ensemble_var(away) if log_weights is None else weighted_var(away, log_weights)


def mean_and_tangents(space: Space, ensemble: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """The mean ``[*B, P]`` of members, and the tangents ``[*B, E, D]`` to them, by two steps from a point near it.

    For members that an update has just placed about ``start`` ``[*B, P]``; wide ones need more, see :meth:`Space.mean`.
    """
    mean = start
    for _ in range(2):
        away = space.minus(ensemble, mean.unsqueeze(-2))
        mean = space.plus(mean, away.mean(-2))
    return mean, away
