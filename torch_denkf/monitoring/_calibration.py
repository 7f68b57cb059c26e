"""Calibration tables that map statistics of clean data to their theoretical distribution."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.monitoring.chi_square import chi_square_quantile

__all__ = ["IDENTITY", "check_observation_dim", "chi_square_table", "empirical_quantile", "score_table", "sign_limits"]

_LEVELS = (0.01, *(0.05 * n for n in range(1, 20)), 0.975, 0.99, 0.995, 0.998, 0.999, 0.9995, 0.9999)
#: Knots and heights ``[2, N]`` of the identity map.
IDENTITY = torch.arange(len(_LEVELS) + 2.0).repeat(2, 1)


def check_observation_dim(expected: int, innovation: Tensor, name: str) -> None:
    """Checks that the innovations ``[*B, O]`` have the expected number of components.

    Raises:
        ValueError: if they have another number; ``name`` is for the message.
    """
    if innovation.shape[-1] != expected:
        raise ValueError(
            f"{name} was given observation_dim={expected}, and the reading has {innovation.shape[-1]} components; "
            f"pass observation_dim={innovation.shape[-1]}."
        )


def empirical_quantile(values: Tensor, levels: Tensor) -> Tensor:
    """Returns order statistics of ``[M]`` at ``levels``; ``torch.quantile`` takes no more than 16 million."""
    return values.sort().values[(levels * (len(values) - 1)).round().long()]


def chi_square_table(nis: Tensor, freedom: int) -> Tensor:
    """Returns knots and heights ``[2, N]`` that map ``nis`` ``[M]`` of clean data to chi-square; linear beyond."""
    levels = _levels(len(nis))
    measured = _rising(empirical_quantile(nis, levels).clamp_min(1e-9))
    expected = torch.tensor([chi_square_quantile(1 - level, freedom) for level in levels.tolist()])
    knots = torch.cat([torch.zeros(1), measured, 10 * measured[-1:]])
    return torch.stack([knots, torch.cat([torch.zeros(1), expected, 10 * expected[-1:]])]).float()


def score_table(values: Tensor) -> Tensor:
    """Returns knots and heights ``[2, N]`` that map ``values`` ``[M]`` of clean data to standard normal scores.

    Beyond the data, one standard deviation of them is a score of one.
    """
    levels, spread = _levels(len(values)), values.std().clamp_min(1e-6)
    measured = _rising(empirical_quantile(values, levels))
    scores = torch.special.ndtri(levels)
    knots = torch.cat([measured[:1] - spread, measured, measured[-1:] + spread])
    return torch.stack([knots, torch.cat([scores[:1] - 1, scores, scores[-1:] + 1])]).float()


def sign_limits(values: Tensor, rate: float, floor: Tensor, margin: float) -> Tensor:
    """Returns limits ``[K]`` that any of the signs ``[M, K]`` exceeds in at most a share ``rate`` of clean rows.

    Each limit is ``margin`` times a quantile, at least ``floor`` ``[K]``. NaN is left out.
    """
    level = torch.tensor([1 - rate / values.shape[-1]], dtype=torch.float64)
    limits = []
    for column in values.unbind(-1):
        known = column[~column.isnan()].double()
        limits.append(empirical_quantile(known, level).squeeze(0) if len(known) else known.new_tensor(torch.inf))
    return torch.maximum(margin * torch.stack(limits), floor.double()).to(floor.dtype)


def _levels(count: int) -> Tensor:
    """Returns the levels that a sample of this size resolves, ascending."""
    levels = torch.tensor(_LEVELS, dtype=torch.float64)
    return levels.clamp(max=1 - 1 / (count + 1)) + 1e-9 * torch.arange(len(levels))


def _rising(values: Tensor) -> Tensor:
    """Separates equal values by steps that float32 resolves."""
    step = 1e-5 * values.abs().max().clamp_min(1e-9)
    return values.cummax(0).values + step * torch.arange(len(values))
