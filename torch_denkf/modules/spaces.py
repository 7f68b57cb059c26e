"""Conversions of beliefs and readings on a space to tangents at a mean, which are plain numbers."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import Space

__all__ = ["mean_and_tangents", "mean_reading", "narrowed_mask"]


def narrowed_mask(space: Space | None, observed: Tensor | None) -> Tensor | None:
    """Narrows the mask of a reading to whole rotations and vectors, see :meth:`Space.told`."""
    return observed if space is None or observed is None else space.told(observed)[1]


def mean_reading(space: Space | None, samples: Tensor, observed: Tensor | None) -> Tensor:
    """Returns the mean ``[*B, Q]`` of samples of a reading ``[*B, E, Q]``; neutral where a mask marks them missing."""
    if space is None:
        return samples.mean(-2)
    if observed is not None:
        samples = torch.where(space.told(observed)[0].unsqueeze(-2), samples, space.neutral(samples))
    return space.mean(samples)


def mean_and_tangents(space: Space, ensemble: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the mean ``[*B, P]`` of members and the tangents ``[*B, E, D]`` to them, by two iterations.

    ``start`` ``[*B, P]`` is a point near the mean, as after an update; members that are spread widely need more
    iterations, see :meth:`Space.mean`.
    """
    mean = start
    for _ in range(2):
        away = space.minus(ensemble, mean.unsqueeze(-2))
        mean = space.plus(mean, away.mean(-2))
    return mean, away
