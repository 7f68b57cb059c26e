"""Standard-normal draws of an ensemble whose sample moments equal those of the distribution."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_choice
from torch_denkf.functional.linalg import semidefinite_solve, whitened

__all__ = ["exact_draws", "is_exact"]


def is_exact(draws: str) -> bool:
    """Tells whether ``draws`` selects exact draws.

    Raises:
        ValueError: if ``draws`` is neither ``"exact"`` nor ``"random"``.
    """
    check_choice("draws", draws, ("exact", "random"))
    return draws == "exact"


def exact_draws(normal: Tensor, *uncorrelated: Tensor) -> Tensor:
    """Makes normal draws exact to second order: mean 0, sample covariance I, uncorrelated with the members.

    Random draws of E members have by chance a mean, a covariance error, and correlations with the members, each of
    size 1 / sqrt(E). In an ensemble that adds them in each step, these errors accumulate, and its spread departs from
    Q. Exact draws have no such errors; for a linear Gaussian system such an ensemble is the Kalman filter.

    All three properties need E of at least S + 9/8 q + 3. With fewer members mean and covariance are exact, and the
    draws are uncorrelated with as many directions of the members as possible; below 9/8 q + 3 only the mean is exact:
    q draws in little more than q dimensions are nearly dependent, and whitening them would magnify rounding.

    Args:
        normal: standard-normal draws, ``[*B, E, q]``.
        *uncorrelated: members, ``[*B, E, S]`` each, with which the draws shall be uncorrelated. If E is too small
            for all, the first argument takes precedence.

    Returns:
        Draws ``[*B, E, q]``; zero where ``normal`` has no spread.

    Reference:
        Pham, "Stochastic methods for sequential data assimilation in strongly nonlinear systems", Monthly Weather
        Review 129, 2001; Hoteit, Pham, Gharamti, Luo, "Mitigating observation perturbation sampling errors in the
        stochastic EnKF", Monthly Weather Review 143, 2015.

    Example:
        >>> members = torch.randn(16, 3)
        >>> draws = exact_draws(torch.randn(16, 2), members)
        >>> torch.allclose(draws.mT @ draws / 15, torch.eye(2), atol=1e-4), (draws.mT @ members).abs().max() < 1e-3
        (True, tensor(True))
    """
    size, dim = normal.shape[-2:]
    draws = normal - normal.mean(-2, keepdim=True)
    room = size - 3 - dim - dim // 8
    if room < 0 or not dim:
        return draws
    if uncorrelated and room:
        away, *others = map(_anomalies, uncorrelated)
        if away.shape[-1] > room:
            # Combinations of the columns along the largest variations of the anomalies, whatever their units.
            square = away.square().sum(-2, keepdim=True)
            away = (away @ (away / torch.where(square > 0, square, 1)).mT)[..., :room]
        for more in others:
            away = torch.cat([away, more], -1) if away.shape[-1] + more.shape[-1] <= room else away
        away = away.to(draws.dtype)
        draws = draws - away @ semidefinite_solve(away.mT @ away, away.mT @ draws)
        draws = draws - draws.mean(-2, keepdim=True)  # anomalies far below their mean sum to rounding, not to zero
    return whitened(draws, draws.mT @ draws / (size - 1))


def _anomalies(members: Tensor) -> Tensor:
    """Returns the deviations from the mean, scaled to at most 1, so that squares neither vanish nor overflow."""
    away = members - members.mean(-2, keepdim=True)
    scale = away.detach().abs().amax(-2, keepdim=True)
    return away * torch.where(scale > torch.finfo(away.dtype).tiny, 1 / scale, 0)
