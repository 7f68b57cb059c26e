"""Plots of calibration: rank histograms with their band, and errors over spread."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import Space
from torch_denkf.metrics.calibration import around_mean, check_variance
from torch_denkf.metrics.state import check_level, known_tangents, state_difference

__all__ = ["SpreadError", "histogram_band", "rank_histogram", "spread_error"]


class SpreadError(NamedTuple):
    """Result of :func:`spread_error`.

    Attributes:
        spread: root mean square of the predicted standard deviation in each bin, ``[S, bins]``, ascending.
        error: root mean square of the mean's error in the same bins, ``[S, bins]``.
    """

    spread: Tensor
    error: Tensor


def rank_histogram(
    ensemble: Tensor,
    truth: Tensor,
    *,
    log_weight: Tensor | None = None,
    space: Space | None = None,
) -> Tensor:
    """Counts how often the truth falls into each of the E+1 gaps between and beyond the sorted members.

    The histogram is flat, up to chance, for a calibrated ensemble, Gaussian or not. It is high at both ends for an
    overconfident one. A truth equal to some members is divided equally among the gaps next to them.

    Args:
        ensemble: ``[*B, E, S]``.
        truth: ``[*B, S]``, in the same units.
        log_weight: weights of particles, ``[*B, E]``. A particle of weight w counts as E w members of equal weight, and
            a truth between two ranks is divided between both. Without it, all weights are equal.
        space: space of members and truth; ``None`` for vectors. Tangents at the members' mean are ranked.

    Returns:
        Counts, ``[S, E+1]`` float64; each row sums to the number of states in ``*B``.

    Raises:
        ValueError: if the shapes do not match, if a value is not finite, or for points of another space.

    Reference:
        Hamill 2001, "Interpretation of rank histograms for verifying ensemble forecasts", Mon. Weather Rev. 129.

    Example:
        >>> members = torch.tensor([[1.0], [2.0], [3.0]]).expand(4, 3, 1)
        >>> rank_histogram(members, torch.tensor([[0.0], [2.5], [2.6], [2.0]]))
        tensor([[1.0000, 0.5000, 2.5000, 0.0000]], dtype=torch.float64)
    """
    count = torch.ones_like(ensemble[..., :1], dtype=torch.float64)
    if log_weight is not None:
        if log_weight.shape != ensemble.shape[:-1]:
            raise ValueError(f"log_weight must be [*B, E], {list(ensemble.shape[:-1])}; got {list(log_weight.shape)}")
        count = log_weight.shape[-1] * log_weight.double().softmax(-1).unsqueeze(-1)
    members, offset = around_mean(ensemble, truth, space, count)
    if not bool(members.isfinite().all() and offset.isfinite().all()):
        raise ValueError("ensemble and truth must be finite; leave out the rows that are not")
    offset, size = offset.unsqueeze(-2), members.shape[-2]
    below = count.where(members < offset, 0.0).sum(-2).flatten(0, -2).T  # [S, N]
    above = below + count.where(members == offset, 0.0).sum(-2).flatten(0, -2).T + 1
    part = 1.0 / (above - below)
    steps = torch.zeros(members.shape[-1], size + 3, dtype=torch.float64, device=members.device)
    # each truth is divided equally among the ranks between its edges
    for edge, height in ((below, part), (above, -part)):
        whole = edge.floor().clamp(max=size + 1)
        steps.scatter_add_(1, whole.long(), (1 - edge + whole) * height)
        steps.scatter_add_(1, whole.long() + 1, (edge - whole) * height)
    return steps.cumsum(1)[:, : size + 1]


def histogram_band(samples: int, bins: int, *, level: float = 0.99) -> tuple[int, int]:
    """Returns bounds that all bars of a flat histogram satisfy jointly with at least probability ``level``.

    Each bar is binomial, and outside with a probability of at most (1 - level) / bins (Bonferroni).

    Args:
        samples: independent samples in the histogram. Errors of successive steps are not independent: use every n-th.
        bins: number of bins.
        level: probability of the band.

    Returns:
        Smallest and largest count.

    Raises:
        ValueError: if ``level`` is not in (0, 1), or without samples or bins.

    Example:
        >>> histogram_band(1000, 10)
        (70, 132)
    """
    check_level(level)
    if samples < 1 or bins < 1:
        raise ValueError(f"a histogram needs samples and bins; got {samples} samples and {bins} bins")
    if bins == 1:
        return samples, samples
    counts = torch.arange(samples + 1, dtype=torch.float64)
    ways = torch.lgamma(counts.max() + 1) - torch.lgamma(counts + 1) - torch.lgamma(samples - counts + 1)
    share = torch.tensor(1 / bins, dtype=torch.float64)
    mass = (ways + counts * share.log() + (samples - counts) * (1 - share).log()).exp()
    tail = (1 - level) / bins / 2
    low = int((mass.cumsum(0) <= tail).sum())
    beyond = mass.flip(0).cumsum(0).flip(0) - mass  # P(count > k)
    return low, int((beyond > tail).sum())


def spread_error(
    mean: Tensor,
    variance: Tensor,
    truth: Tensor,
    *,
    bins: int = 8,
    ensemble_size: int | None = None,
    space: Space | None = None,
) -> SpreadError:
    """Returns the predicted spread and actual error, in bins of states with similar spread.

    A calibrated filter has spread = error in each bin.

    Args:
        mean: ``[*B, S]``.
        variance: ``[*B, S]``; for an ensemble with divisor E-1.
        truth: ``[*B, S]``, in the same units; NaN is left out.
        bins: number of bins, of equal size up to one state, by the rank of the spread.
        ensemble_size: E, which scales the variance with (E+1)/E, see :func:`spread_skill_ratio`; ``None`` for a
            distribution whose moments are exact.
        space: space of mean and truth, points ``[*B, P]``; ``None`` for vectors. The variance is that of tangents.

    Returns:
        A :class:`SpreadError`, in the units of the state.

    Raises:
        ValueError: if the shapes differ, if a variance is negative, or if there are fewer states than bins.

    Example:
        >>> mean, truth = torch.zeros(4, 1), torch.tensor([[1.0], [-1.0], [3.0], [-3.0]])
        >>> spread_error(mean, torch.tensor([[1.0], [1.0], [4.0], [4.0]]), truth, bins=2)
        SpreadError(spread=tensor([[1., 2.]]), error=tensor([[1., 3.]]))
    """
    difference = state_difference(mean, truth, space=space)
    check_variance(variance, difference)
    truth = known_tangents(truth, space)
    known = ~truth.isnan().flatten(0, -2)
    fewest = int(known.sum(0).min())
    if not 1 <= bins <= fewest:
        raise ValueError(f"{bins} bins need at least one state each; got {fewest} states whose truth is known")
    factor = 1.0 if ensemble_size is None else (ensemble_size + 1) / ensemble_size
    columns: tuple[list[Tensor], list[Tensor]] = ([], [])
    for dim in range(truth.shape[-1]):
        spread, square = (v.flatten(0, -2)[known[:, dim], dim] for v in (factor * variance, difference.square()))
        order = spread.argsort()
        for column, values in zip(columns, (spread, square), strict=True):
            column.append(torch.stack([part.mean().sqrt() for part in values[order].tensor_split(bins)]))
    return SpreadError(*map(torch.stack, columns))
