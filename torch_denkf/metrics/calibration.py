"""Does the spread of a belief say how wrong its mean is? Spread over skill, and how often intervals hold the truth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_denkf.metrics._paths import wrap_angle
from torch_denkf.metrics.state import state_difference

__all__ = ["ensemble_interval_coverage", "interval_coverage", "spread_skill_ratio"]


def spread_skill_ratio(
    mean: torch.Tensor, variance: torch.Tensor, truth: torch.Tensor, ensemble_size: int | None = None
):
    r"""Spread over skill, :math:`\sqrt{\frac{E+1}{E}\,\overline{s^2}} / \mathrm{RMSE}`: one for a calibrated ensemble.

    The truth of a calibrated ensemble is one more draw from its distribution; its squared distance from the mean of E
    members is then (E+1)/E times their variance, on average.

    Args:
        mean: of the ensemble, ``[*B, S]``.
        variance: of the ensemble with divisor E-1, ``[*B, S]``.
        truth: ``[*B, S]``, in the same units.
        ensemble_size: E; ``None`` for a distribution whose moments are exact.

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
    if not mean.shape == variance.shape == truth.shape:
        shapes = [list(part.shape) for part in (mean, variance, truth)]
        raise ValueError(f"mean, variance and truth need one shape; got {shapes}.")
    factor = 1.0 if ensemble_size is None else (ensemble_size + 1) / ensemble_size
    batch = tuple(range(mean.ndim - 1))
    return (factor * variance.mean(batch)).sqrt() / (mean - truth).square().mean(batch).sqrt()


def interval_coverage(
    mean: Tensor, variance: Tensor, truth: Tensor, *, level: float = 0.9, angles: Sequence[int] = ()
) -> Tensor:
    """Share of the truth inside the central interval of a Gaussian, ``mean ± z sqrt(variance)``.

    It is ``level`` for a calibrated belief, less for an overconfident one.

    Args:
        mean: ``[*B, S]``.
        variance: ``[*B, S]``.
        truth: ``[*B, S]``, in the same units.
        level: probability of the interval.
        angles: dimensions that are angles in rad, whose errors are wrapped.

    Returns:
        One share a state dimension, ``[S]``.

    Raises:
        ValueError: if the shapes differ, if ``level`` is not in (0, 1), or if a variance is negative.

    Example:
        >>> truth = torch.tensor([[-2.0], [-1.0], [0.0], [1.5]])
        >>> interval_coverage(torch.zeros(4, 1), torch.ones(4, 1), truth, level=0.9)  # z = 1.645
        tensor([0.7500])
    """
    error = state_difference(mean, truth, angles=angles)
    if variance.shape != error.shape:
        raise ValueError(f"variance must have the shape of the mean, {list(error.shape)}; got {list(variance.shape)}.")
    if bool((variance < 0).any()):
        raise ValueError(f"variances cannot be negative; the least is {variance.min().item():.3g}.")
    _check_level(level)
    quantile = torch.special.ndtri(torch.tensor(0.5 + level / 2, dtype=torch.float64)).item()
    return _share(error.abs() <= quantile * variance.sqrt())


def ensemble_interval_coverage(
    ensemble: Tensor, truth: Tensor, *, level: float = 0.9, angles: Sequence[int] = ()
) -> Tensor:
    """Share of the truth inside the central interval of the members: ``level`` if calibrated, Gaussian or not.

    The truth of a calibrated ensemble is as likely to fall into any of the E+1 gaps between and beyond the sorted
    members. The interval therefore ends at rank p (E+1), p = (1 - level)/2, between two members where that is no whole
    number.

    Args:
        ensemble: ``[*B, E, S]``.
        truth: ``[*B, S]``, in the same units.
        level: probability of the interval, at most (E-1)/(E+1), which is what all members span.
        angles: dimensions that are angles in rad; members are taken around their mean direction.

    Returns:
        One share a state dimension, ``[S]``.

    Raises:
        ValueError: if the shapes do not fit, or if ``level`` is not in (0, 1) or more than the members can tell.
        IndexError: if ``angles`` names no dimension.

    Reference:
        Hyndman & Fan 1996, "Sample quantiles in statistical packages", Am. Stat. 50, definition 6.

    Example:
        >>> members = torch.arange(19.0).unsqueeze(-1).expand(2, 19, 1)
        >>> ensemble_interval_coverage(members, torch.tensor([[0.5], [18.5]]), level=0.9)  # from 0 to 18
        tensor([0.5000])
    """
    if ensemble.ndim != truth.ndim + 1 or (*ensemble.shape[:-2], ensemble.shape[-1]) != truth.shape:
        raise ValueError(
            f"ensemble must be [*B, E, S] and truth [*B, S]; got {list(ensemble.shape)} and {list(truth.shape)}."
        )
    _check_level(level)
    size = ensemble.shape[-2]
    rank = (1 - level) / 2 * (size + 1) - 1  # from zero
    if rank < -1e-9:
        raise ValueError(
            f"{size} members span {max(size - 1, 0)}/{size + 1} of their distribution; level {level} needs more "
            "members, or pass a smaller level."
        )
    centre = ensemble.mean(-2)
    for dim in angles:
        centre[..., dim] = torch.atan2(ensemble[..., dim].sin().mean(-1), ensemble[..., dim].cos().mean(-1))
    offset = state_difference(truth, centre, angles=angles)
    members = ensemble - centre.unsqueeze(-2)
    for dim in angles:
        members[..., dim] = wrap_angle(members[..., dim].clone())
    members = members.sort(-2).values
    whole = max(int(rank + 1e-9), 0)
    part = max(rank - whole, 0.0)
    beyond = min(whole + 1, size - 1)
    lower = torch.lerp(members[..., whole, :], members[..., beyond, :], part)
    upper = torch.lerp(members[..., size - 1 - whole, :], members[..., size - 1 - beyond, :], part)
    return _share((lower <= offset) & (offset <= upper))


def _check_level(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is the probability of the interval, in (0, 1); got {level}.")


def _share(inside: Tensor) -> Tensor:
    return inside.reshape(-1, inside.shape[-1]).to(torch.get_default_dtype()).mean(0)
