"""Does the spread of a belief say how wrong its mean is?

Spread over skill, shares of intervals that hold the truth, and histograms that are flat for a calibrated belief. A
truth that is NaN is not known, and does not count.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.metrics.state import check_level, known_tangents, mean_of_known, state_difference

__all__ = [
    "SpreadError",
    "ensemble_interval",
    "ensemble_interval_coverage",
    "histogram_band",
    "interval_coverage",
    "pit",
    "rank_histogram",
    "spread_error",
    "spread_skill_ratio",
]


class SpreadError(NamedTuple):
    """Holds the results of :func:`spread_error`.

    Attributes:
        spread: root mean square of the predicted standard deviation in each bin, ``[S, bins]``, ascending.
        error: root mean square of the mean's error in the same bins, ``[S, bins]``.
    """

    spread: Tensor
    error: Tensor


def spread_skill_ratio(
    mean: torch.Tensor,
    variance: torch.Tensor,
    truth: torch.Tensor,
    ensemble_size: int | None = None,
    *,
    space: Space | None = None,
):
    r"""Spread over skill, :math:`\sqrt{\frac{E+1}{E}\,\overline{s^2}} / \mathrm{RMSE}`: one for a calibrated ensemble.

    The truth of a calibrated ensemble is one more draw from its distribution; its squared distance from the mean of E
    members is then (E+1)/E times their variance, on average.

    Args:
        mean: of the ensemble, ``[*B, S]``.
        variance: of the ensemble with divisor E-1, ``[*B, S]``.
        truth: ``[*B, S]``, in the same units; what is NaN does not count.
        ensemble_size: E; ``None`` for a distribution whose moments are exact.
        space: whose points ``[*B, P]`` mean and truth are; the variance is one of tangents.

    Returns:
        One ratio a state dimension, ``[S]``.

    Raises:
        ValueError: if the shapes differ.

    Reference:
        Fortin et al., "Why should ensemble spread match the RMSE of the ensemble mean?", J. Hydrometeorol. 15, 2014.

    Example:
        >>> rng = torch.Generator().manual_seed(0)
        >>> draws = torch.randn(10000, 9, 1, generator=rng)  # eight members and the truth
        >>> members, truth = draws[:, :8], draws[:, 8]
        >>> spread_skill_ratio(members.mean(1), members.var(1), truth, 8).round(decimals=1)
        tensor([1.])
    """
    difference = state_difference(mean, truth, space=space)
    _check_variance(variance, difference)
    truth = known_tangents(truth, space)
    factor = 1.0 if ensemble_size is None else (ensemble_size + 1) / ensemble_size
    spread, error = (mean_of_known(values, truth) for values in (variance, difference.square()))
    return (factor * spread).sqrt() / error.sqrt()


def interval_coverage(
    mean: Tensor,
    variance: Tensor,
    truth: Tensor,
    *,
    level: float = 0.9,
    space: Space | None = None,
) -> Tensor:
    """Share of the truth inside the central interval of a Gaussian, ``mean ± z sqrt(variance)``.

    It is ``level`` for a calibrated belief, less for an overconfident one. Without ``space`` variances of points are of
    other axes than their differences: :func:`torch_denkf.diagnosis.evaluate` takes the space from a filter.

    Args:
        mean: ``[*B, S]``.
        variance: ``[*B, S]``.
        truth: ``[*B, S]``, in the same units; what is NaN does not count.
        level: probability of the interval.
        space: whose points ``[*B, P]`` mean and truth are; ``None`` for plain numbers. The variance is one of tangents.

    Returns:
        One share a state dimension, ``[S]``; NaN where a belief is.

    Raises:
        ValueError: if the shapes differ, if ``level`` is not in (0, 1), or if a variance is negative.

    Example:
        >>> truth = torch.tensor([[-2.0], [-1.0], [0.0], [1.5]])
        >>> interval_coverage(torch.zeros(4, 1), torch.ones(4, 1), truth, level=0.9)  # z = 1.645
        tensor([0.7500])
    """
    error = state_difference(mean, truth, space=space)
    _check_variance(variance, error)
    check_level(level)
    quantile = torch.special.ndtri(torch.tensor(0.5 + level / 2, dtype=torch.float64)).item()
    return _share(quantile * variance.sqrt() - error.abs(), known_tangents(truth, space))


def ensemble_interval_coverage(
    ensemble: Tensor,
    truth: Tensor,
    *,
    level: float = 0.9,
    space: Space | None = None,
) -> Tensor:
    """Share of the truth inside the central interval of the members: ``level`` if calibrated, Gaussian or not.

    The truth of a calibrated ensemble is as likely to fall into any of the E+1 gaps between and beyond the sorted
    members. The interval therefore ends at rank p (E+1), p = (1 - level)/2, between two members where that is no whole
    number.

    Args:
        ensemble: ``[*B, E, S]``.
        truth: ``[*B, S]``, in the same units; what is NaN does not count.
        level: probability of the interval, at most (E-1)/(E+1), which is what all members span.
        space: whose points members and truth are; ``None`` for plain numbers. Tangents at the members' mean are ranked.

    Returns:
        One share a state dimension, ``[S]``; NaN where a belief is.

    Raises:
        ValueError: if the shapes do not fit, ``level`` is not in (0, 1) or more than the members can tell, or
            points of another space.

    Reference:
        Hyndman & Fan 1996, "Sample quantiles in statistical packages", Am. Stat. 50, definition 6.

    Example:
        >>> members = torch.arange(19.0).unsqueeze(-1).expand(2, 19, 1)
        >>> ensemble_interval_coverage(members, torch.tensor([[0.5], [18.5]]), level=0.9)  # from 0 to 18
        tensor([0.5000])
    """
    members, offset = _around_mean(ensemble, truth, space)
    lower, upper = ensemble_interval(members, level=level)
    return _share(torch.minimum(offset - lower, upper - offset), known_tangents(truth, space))


def ensemble_interval(ensemble: Tensor, *, level: float = 0.9) -> tuple[Tensor, Tensor]:
    """Central interval of the members, which holds the truth of a calibrated ensemble with probability ``level``.

    It ends at rank p (E+1) of the sorted members, p = (1 - level)/2, between two members where that is no whole number.

    Args:
        ensemble: ``[*B, E, S]``. Bring angles that straddle ±π to one side before.
        level: probability of the interval, at most (E-1)/(E+1), which is what all members span.

    Returns:
        The lower and the upper end, both ``[*B, S]``, in the members' units.

    Raises:
        ValueError: if ``level`` is not in (0, 1) or more than the members can tell.

    Example:
        >>> low, high = ensemble_interval(torch.arange(19.0).unsqueeze(-1), level=0.8)
        >>> low.item(), high.item()
        (1.0, 17.0)
    """
    check_level(level)
    size = ensemble.shape[-2]
    rank = (1 - level) / 2 * (size + 1) - 1  # from zero
    if rank < -1e-9:
        raise ValueError(
            f"{size} members span {max(size - 1, 0)}/{size + 1} of their distribution; level {level} needs more "
            "members, or pass a smaller level."
        )
    members = ensemble.sort(-2).values
    whole = max(int(rank + 1e-9), 0)
    part = max(rank - whole, 0.0)
    beyond = min(whole + 1, size - 1)
    lower = torch.lerp(members[..., whole, :], members[..., beyond, :], part)
    upper = torch.lerp(members[..., size - 1 - whole, :], members[..., size - 1 - beyond, :], part)
    return lower, upper


def pit(mean: Tensor, variance: Tensor, truth: Tensor, *, space: Space | None = None) -> Tensor:
    r"""Probability integral transform of the truth, :math:`\Phi((x - \bar x) / \sqrt{s^2})`.

    It is uniform in [0, 1] for a calibrated Gaussian belief. An overconfident one gathers it at both ends, a timid one
    in the middle, and a biased one at one end.

    Args:
        mean: ``[*B, S]``.
        variance: ``[*B, S]``.
        truth: ``[*B, S]``, in the same units.
        space: whose points ``[*B, P]`` mean and truth are; ``None`` for plain numbers. The variance is one of tangents.

    Returns:
        ``[*B, S]`` in [0, 1]. Where the variance is zero: 0 or 1, and 0.5 for a truth that equals the mean. NaN where
        the truth is.

    Raises:
        ValueError: if the shapes differ, or if a variance is negative.

    Reference:
        Gneiting, Balabdaoui & Raftery 2007, "Probabilistic forecasts, calibration and sharpness", JRSS B 69.

    Example:
        >>> pit(torch.zeros(3, 1), torch.ones(3, 1), torch.tensor([[-1.2816], [0.0], [1.2816]])).flatten()
        tensor([0.1000, 0.5000, 0.9000])
    """
    error = state_difference(truth, mean, space=space)
    _check_variance(variance, error)
    score = error / variance.sqrt()
    return torch.special.ndtr(torch.where((error == 0) & (variance == 0), 0.0, score))


def rank_histogram(
    ensemble: Tensor,
    truth: Tensor,
    *,
    log_weight: Tensor | None = None,
    space: Space | None = None,
) -> Tensor:
    """Counts how often the truth falls into each of the E+1 gaps between and beyond the sorted members.

    The histogram is flat, up to chance, for a calibrated ensemble, Gaussian or not. It is high at both ends for an
    overconfident one. A truth that equals some members counts in equal parts in all the gaps that they separate.

    Args:
        ensemble: ``[*B, E, S]``.
        truth: ``[*B, S]``, in the same units.
        log_weight: of particles, ``[*B, E]``. A particle of weight w counts as E w members of equal weight, and a truth
            between two ranks in both. Without it, all members weigh the same.
        space: whose points members and truth are; ``None`` for plain numbers. Tangents at the members' mean are ranked.

    Returns:
        Counts, ``[S, E+1]`` float64; each row sums to the number of states in ``*B``.

    Raises:
        ValueError: if the shapes do not fit, if a value is not finite, or for points of another space.

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
    members, offset = _around_mean(ensemble, truth, space, count)
    if not bool(members.isfinite().all() and offset.isfinite().all()):
        raise ValueError("ensemble and truth must be finite; leave out the rows that are not")
    offset, size = offset.unsqueeze(-2), members.shape[-2]
    below = count.where(members < offset, 0.0).sum(-2).flatten(0, -2).T  # [S, N]
    above = below + count.where(members == offset, 0.0).sum(-2).flatten(0, -2).T + 1
    part = 1.0 / (above - below)
    steps = torch.zeros(members.shape[-1], size + 3, dtype=torch.float64, device=members.device)
    for edge, height in ((below, part), (above, -part)):  # each truth lies evenly on the ranks between its edges
        whole = edge.floor().clamp(max=size + 1)
        steps.scatter_add_(1, whole.long(), (1 - edge + whole) * height)
        steps.scatter_add_(1, whole.long() + 1, (edge - whole) * height)
    return steps.cumsum(1)[:, : size + 1]


def histogram_band(samples: int, bins: int, *, level: float = 0.99) -> tuple[int, int]:
    """Counts between which all bars of a flat histogram stay together with at least probability ``level``.

    Each bar is binomial; by Bonferroni's bound each is granted a share (1 - level) / bins of being outside.

    Args:
        samples: independent samples in the histogram. Errors of successive steps are not independent: use every n-th.
        bins: of the histogram.
        level: probability of the band.

    Returns:
        The least and the largest count.

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
    """Predicted spread and actual error, in bins of states with similar spread.

    A filter that knows how wrong it is has spread = error in each bin.

    Args:
        mean: ``[*B, S]``.
        variance: ``[*B, S]``; of an ensemble with divisor E-1.
        truth: ``[*B, S]``, in the same units; what is NaN does not count.
        bins: of equal size up to one state, by the rank of the spread.
        ensemble_size: E, which scales the variance with (E+1)/E, see :func:`spread_skill_ratio`; ``None`` for a
            distribution whose moments are exact.
        space: whose points ``[*B, P]`` mean and truth are; ``None`` for plain numbers. The variance is one of tangents.

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
    _check_variance(variance, difference)
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


def _around_mean(
    ensemble: Tensor, truth: Tensor, space: Space | None, count: Tensor | float = 1.0
) -> tuple[Tensor, Tensor]:
    """Members and truth relative to the members' mean: ``[*B, E, S]`` and ``[*B, S]``.

    Of points of a space they are tangents: members and truth that are drawn alike are so in these axes, too.
    """
    if ensemble.ndim != truth.ndim + 1 or (*ensemble.shape[:-2], ensemble.shape[-1]) != truth.shape:
        raise ValueError(
            f"ensemble must be [*B, E, S] and truth [*B, S]; got {list(ensemble.shape)} and {list(truth.shape)}."
        )
    space = check_space("space", space)
    if space is not None:
        size = ensemble.shape[-2]
        share = torch.full_like(ensemble[..., 0], 1 / size) if isinstance(count, float) else count.squeeze(-1) / size
        centre = space.mean(ensemble, share.to(ensemble.dtype))
        return space.minus(ensemble, centre.unsqueeze(-2)), space.minus(truth, centre)
    centre = (count * ensemble).mean(-2)
    return ensemble - centre.unsqueeze(-2), truth - centre


def _check_variance(variance: Tensor, error: Tensor) -> None:
    if variance.shape != error.shape:
        raise ValueError(
            f"variance must have the shape of the mean, {list(error.shape)}; got {list(variance.shape)}. If the states "
            "are points of a space, pass space=."
        )
    if bool((variance < 0).any()):
        raise ValueError(f"variances cannot be negative; the least is {variance.min().item():.3g}.")


def _share(margin: Tensor, truth: Tensor) -> Tensor:
    """The share of margins ``[*B, S]`` that are not negative; NaN where one is NaN."""
    inside = (margin >= 0).to(torch.get_default_dtype())
    return mean_of_known(inside.where(~margin.isnan(), torch.nan), truth)
