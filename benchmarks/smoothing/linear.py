"""What smoothing of readings can reach at all: the best weights of the readings before and after."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.smoothing.gaussian import Series

BACK = 10  # readings before the present one


def windows(series: Series, later: int) -> Tensor:
    """The readings around each time and a one, ``[N, T, D, BACK + later + 2]``; those that are missing are held."""
    reading, last = [], series.reading[:, 1]
    for now, seen in zip(series.reading.unbind(1), series.observed.unbind(1), strict=True):
        last = torch.where(seen, now, last)
        reading.append(last)
    held = torch.stack(reading, 1)
    times = torch.arange(held.shape[1]).unsqueeze(-1) + torch.arange(-BACK, later + 1)
    around = held[:, times.clamp(0, held.shape[1] - 1)].transpose(2, 3)
    return torch.cat([around, torch.ones_like(around[..., :1])], -1)


def weights(series: Sequence[Series], later: int) -> Tensor:
    """The weights of least squares, ``[D, BACK + later + 2]``."""
    inputs = torch.cat([windows(each, later)[:, 1 : -later or None].flatten(0, 1) for each in series]).movedim(1, 0)
    truth = torch.cat([each.truth[:, 1 : -later or None].flatten(0, 1) for each in series]).mT.unsqueeze(-1)
    gram = inputs.mT @ inputs
    level = 1e-9 * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    return torch.linalg.solve(gram + level * torch.eye(gram.shape[-1], dtype=gram.dtype), inputs.mT @ truth).squeeze(-1)


def estimates(series: Series, found: Tensor, later: int) -> Tensor:
    """Weighted readings, ``[N, T, D]``."""
    return (windows(series, later) * found).sum(-1)
