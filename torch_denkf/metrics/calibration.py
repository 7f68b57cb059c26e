"""Calibration of a belief: spread over skill, coverage of intervals, and probability integral transforms.

Components whose truth is NaN are left out.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.metrics.state import check_level, known_tangents, mean_of_known, state_difference

__all__ = [
    "around_mean",
    "check_variance",
    "ensemble_interval",
    "ensemble_interval_coverage",
    "interval_coverage",
    "pit",
    "spread_skill_ratio",
]


def spread_skill_ratio(
    mean: torch.Tensor,
    variance: torch.Tensor,
    truth: torch.Tensor,
    ensemble_size: int | None = None,
    *,
    space: Space | None = None,
):
    r"""Returns spread over skill, :math:`\sqrt{\frac{E+1}{E}\,\overline{s^2}} / \mathrm{RMSE}`: one if calibrated.

    The truth of a calibrated ensemble is one more draw from its distribution; its squared distance from the mean of E
    members is then (E+1)/E times their variance, on average.

    Args:
        mean: mean of the ensemble, ``[*B, S]``.
        variance: variance of the ensemble with divisor E-1, ``[*B, S]``.
        truth: ``[*B, S]``, in the same units; NaN is left out.
        ensemble_size: E; ``None`` for a distribution whose moments are exact.
        space: space of mean and truth, points ``[*B, P]``; the variance is of tangents.

    Returns:
        One ratio per state dimension, ``[S]``.

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
    check_variance(variance, difference)
    truth = known_tangents(truth, space)
    factor = 1.0 if ensemble_size is None else (ensemble_size + 1) / ensemble_size
    spread, error = (mean_of_known(values, truth) for values in (variance, difference.square()))
    return (factor * spread).sqrt() / error.sqrt()


def interval_coverage(
    mean: Tensor, variance: Tensor, truth: Tensor, *, level: float = 0.9, space: Space | None = None
) -> Tensor:
    """Returns the share of the truth inside the central interval of a Gaussian, ``mean ± z sqrt(variance)``.

    It is ``level`` for a calibrated belief, less for an overconfident one. Points need ``space``, since their variances
    are along other axes than their differences; :func:`torch_denkf.diagnosis.evaluate` takes it from a filter.

    Args:
        mean: ``[*B, S]``.
        variance: ``[*B, S]``.
        truth: ``[*B, S]``, in the same units; NaN is left out.
        level: probability of the interval.
        space: space of mean and truth, points ``[*B, P]``; ``None`` for plain numbers. The variance is of tangents.

    Returns:
        One share per state dimension, ``[S]``; NaN if a belief is NaN.

    Raises:
        ValueError: if the shapes differ, if ``level`` is not in (0, 1), or if a variance is negative.

    Example:
        >>> truth = torch.tensor([[-2.0], [-1.0], [0.0], [1.5]])
        >>> interval_coverage(torch.zeros(4, 1), torch.ones(4, 1), truth, level=0.9)  # z = 1.645
        tensor([0.7500])
    """
    error = state_difference(mean, truth, space=space)
    check_variance(variance, error)
    check_level(level)
    quantile = torch.special.ndtri(torch.tensor(0.5 + level / 2, dtype=torch.float64)).item()
    return _share(quantile * variance.sqrt() - error.abs(), known_tangents(truth, space))


def ensemble_interval_coverage(
    ensemble: Tensor, truth: Tensor, *, level: float = 0.9, space: Space | None = None
) -> Tensor:
    """Returns the share of the truth inside the members' central interval: ``level`` if calibrated, Gaussian or not.

    The truth of a calibrated ensemble is equally likely to fall into each of the E+1 gaps between and beyond the sorted
    members. So the interval ends at rank p (E+1), p = (1 - level)/2, interpolated between two members if that is not
    a whole number.

    Args:
        ensemble: ``[*B, E, S]``.
        truth: ``[*B, S]``, in the same units; NaN is left out.
        level: probability of the interval, at most (E-1)/(E+1), the probability of the range of all members.
        space: space of members and truth; ``None`` for plain numbers. Tangents at the members' mean are ranked.

    Returns:
        One share per state dimension, ``[S]``; NaN if a belief is NaN.

    Raises:
        ValueError: if the shapes do not fit, if ``level`` is not in (0, 1) or too large for the number of members, or
            for points of another space.

    Reference:
        Hyndman & Fan 1996, "Sample quantiles in statistical packages", Am. Stat. 50, definition 6.

    Example:
        >>> members = torch.arange(19.0).unsqueeze(-1).expand(2, 19, 1)
        >>> ensemble_interval_coverage(members, torch.tensor([[0.5], [18.5]]), level=0.9)  # from 0 to 18
        tensor([0.5000])
    """
    members, offset = around_mean(ensemble, truth, space)
    lower, upper = ensemble_interval(members, level=level)
    return _share(torch.minimum(offset - lower, upper - offset), known_tangents(truth, space))


def ensemble_interval(ensemble: Tensor, *, level: float = 0.9) -> tuple[Tensor, Tensor]:
    """Returns the members' central interval, which contains the truth with probability ``level`` if calibrated.

    It ends at rank p (E+1) of the sorted members, p = (1 - level)/2, interpolated if that is not a whole number.

    Args:
        ensemble: ``[*B, E, S]``. Unwrap angles that straddle ±π first.
        level: probability of the interval, at most (E-1)/(E+1), the probability of the range of all members.

    Returns:
        The lower and the upper end, both ``[*B, S]``, in the members' units.

    Raises:
        ValueError: if ``level`` is not in (0, 1) or too large for the number of members.

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
    r"""Returns the probability integral transform of the truth, :math:`\Phi((x - \bar x) / \sqrt{s^2})`.

    It is uniform in [0, 1] for a calibrated Gaussian belief. An overconfident belief concentrates it at both ends, an
    underconfident one in the middle, and a biased one at one end.

    Args:
        mean: ``[*B, S]``.
        variance: ``[*B, S]``.
        truth: ``[*B, S]``, in the same units.
        space: space of mean and truth, points ``[*B, P]``; ``None`` for plain numbers. The variance is of tangents.

    Returns:
        ``[*B, S]`` in [0, 1]. For a variance of zero: 0 or 1, and 0.5 for a truth that equals the mean. NaN where the
        truth is NaN.

    Raises:
        ValueError: if the shapes differ, or if a variance is negative.

    Reference:
        Gneiting, Balabdaoui & Raftery 2007, "Probabilistic forecasts, calibration and sharpness", JRSS B 69.

    Example:
        >>> pit(torch.zeros(3, 1), torch.ones(3, 1), torch.tensor([[-1.2816], [0.0], [1.2816]])).flatten()
        tensor([0.1000, 0.5000, 0.9000])
    """
    error = state_difference(truth, mean, space=space)
    check_variance(variance, error)
    score = error / variance.sqrt()
    return torch.special.ndtr(torch.where((error == 0) & (variance == 0), 0.0, score))


def around_mean(
    ensemble: Tensor, truth: Tensor, space: Space | None, count: Tensor | float = 1.0
) -> tuple[Tensor, Tensor]:
    """Returns members and truth relative to the members' mean: ``[*B, E, S]`` and ``[*B, S]``.

    On a space they are tangents: if members and truth have the same distribution, so have their tangents.
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


def check_variance(variance: Tensor, error: Tensor) -> None:
    """Raises unless variances have the shape of the error, and are not negative.

    Raises:
        ValueError: if they are not.
    """
    if variance.shape != error.shape:
        raise ValueError(
            f"variance must have the shape of the mean, {list(error.shape)}; got {list(variance.shape)}. If the states "
            "are points of a space, pass space=."
        )
    if bool((variance < 0).any()):
        raise ValueError(f"variances cannot be negative; the least is {variance.min().item():.3g}.")


def _share(margin: Tensor, truth: Tensor) -> Tensor:
    """Returns the share of margins ``[*B, S]`` that are not negative; NaN if one is NaN."""
    inside = (margin >= 0).to(torch.get_default_dtype())
    return mean_of_known(inside.where(~margin.isnan(), torch.nan), truth)
