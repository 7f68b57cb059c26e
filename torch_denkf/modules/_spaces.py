"""Beliefs and readings on a space: as tangents at a mean, where they are plain numbers."""

from __future__ import annotations

from torch import Tensor

from torch_denkf.functional.manifolds import Space

__all__ = ["mean_and_tangents", "mean_reading"]


def mean_reading(space: Space | None, samples: Tensor) -> Tensor:
    """Returns the mean ``[*B, Q]`` of samples of a reading ``[*B, E, Q]``."""
    return samples.mean(-2) if space is None else space.mean(samples)


def mean_and_tangents(space: Space, ensemble: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """The mean ``[*B, P]`` of members, and the tangents ``[*B, E, D]`` to them, by two steps from a point near it.

    For members that an update has just placed about ``start`` ``[*B, P]``; wide ones need more, see :meth:`Space.mean`.
    """
    mean = start
    for _ in range(2):
        away = space.minus(ensemble, mean.unsqueeze(-2))
        mean = space.plus(mean, away.mean(-2))
    return mean, away
