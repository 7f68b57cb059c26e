"""Standard-normal draws of an ensemble whose sample has the moments that the distribution has."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.linalg import cholesky_of_correlation, semidefinite_solve

__all__ = ["exact_draws"]


def exact_draws(normal: Tensor, *uncorrelated: Tensor) -> Tensor:
    """Makes normal draws exact to second order: mean 0, sample covariance I, uncorrelated with the members.

    Random draws of E members have a mean, a covariance, and correlations with the members by chance, each of size
    1 / sqrt(E). An ensemble that adds them up in each step is far from what its Q says. Exact draws do not; for a
    linear Gaussian system such an ensemble is the Kalman filter.

    For all three E must be at least S + 5/4 q + 3. With fewer members mean and covariance are exact, and the draws
    uncorrelated with as many leading directions of the members as there is room for; with E <= q the mean alone is.

    Args:
        normal: standard-normal draws, ``[*B, E, q]``.
        *uncorrelated: members, ``[*B, E, S]`` each, that the draws are uncorrelated with.

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
    if dim >= size:
        return draws
    room = (
        size - 1 - dim - (2 + dim // 4)
    )  # q draws of just q dimensions are nearly dependent: scaling up their rounding
    if uncorrelated and room > 0:
        away = torch.cat([members - members.mean(-2, keepdim=True) for members in uncorrelated], -1).to(draws.dtype)
        scale = away.detach().abs().amax(-2, keepdim=True)  # squares and their gradients stay within the numbers
        away = away * torch.where(scale > torch.finfo(away.dtype).tiny, 1 / scale, 0)
        if away.shape[-1] > room:
            away = _leading(away, room)
        draws = draws - away @ semidefinite_solve(away.mT @ away, away.mT @ draws)
        draws = draws - draws.mean(-2, keepdim=True)  # anomalies far below their mean sum to rounding, not to zero
    factor, inverse = cholesky_of_correlation(draws.mT @ draws / (size - 1))
    return torch.linalg.solve_triangular(factor, (draws * inverse.unsqueeze(-2)).mT, upper=False).mT


def _leading(away: Tensor, count: int) -> Tensor:
    """Returns columns ``[*B, E, count]`` that span what the anomalies vary most in, each in units of its spread."""
    square = away.square().sum(-2, keepdim=True)
    gram = away @ (away / torch.where(square > 0, square, 1)).mT
    return gram @ gram[..., :count]
