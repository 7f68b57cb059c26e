r"""Mixture of two beliefs, for a reading that may not be about the state, and their responsibilities.

With the probability p the reading is about the state, :math:`y \sim N(h(x), S)`; with 1 - p about something else,
:math:`y \sim b`. The belief then is a mixture: with the responsibility

.. math:: q = \frac{p N(y)}{p N(y) + (1 - p) b(y)}

as the weight of the updated belief, and 1 - q that of the forecast. It is approximated by a belief with the same mean
and covariance.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_denkf.functional.linalg import cholesky

__all__ = ["log_mixture", "mix_members", "mix_moments", "responsibility"]

#: The least that is added to correlations, so that a singular covariance has a factor in double precision.
_RIDGE = 1e-12


def responsibility(probability: Tensor, log_own: Tensor, log_other: Tensor) -> Tensor:
    """Returns the posterior probability that the reading is about the state.

    Args:
        probability: prior probability p, in [0, 1].
        log_own: log-density of a reading about the state, ``log N(y)``.
        log_other: log-density of another reading, ``log b(y)``.

    Returns:
        q, of the same shape; 1 for p = 1 and 0 for p = 0, without a gradient there.

    Examples:
        >>> responsibility(torch.tensor(0.5), torch.tensor(0.3).log(), torch.tensor(0.1).log())
        tensor(0.7500)
    """
    p, sure, never = _open(probability)
    share = (p.log() - (-p).log1p() + log_own - log_other).sigmoid()
    return torch.where(sure, 1, torch.where(never, 0, share))


def log_mixture(probability: Tensor, log_own: Tensor, log_other: Tensor) -> Tensor:
    """Returns the log-density of the mixture, ``log (p N(y) + (1 - p) b(y))``; arguments as of :func:`responsibility`.

    Examples:
        >>> log_mixture(torch.tensor(0.5), torch.tensor(0.3).log(), torch.tensor(0.1).log()).exp()
        tensor(0.2000)
    """
    p, sure, never = _open(probability)
    mixed = torch.logaddexp(p.log() + log_own, (-p).log1p() + log_other)
    return torch.where(sure, log_own, torch.where(never, log_other, mixed))


def _open(probability: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the probability, one half where it is 0 or 1; and where it is 1, and 0."""
    sure, never = probability >= 1, probability <= 0
    return torch.where(sure | never, 0.5, probability), sure, never


def mix_moments(share: Tensor, mean: Tensor, cov: Tensor, other_mean: Tensor, other_cov: Tensor) -> tuple[Tensor, ...]:
    r"""Returns mean and covariance of a mixture of two, :math:`q P_1 + (1 - q) P_2 + q (1 - q) d d^T`.

    Args:
        share: q, of the first, ``[*B, 1]``.
        mean: of the first, ``[*B, S]``.
        cov: of the first, ``[*B, S, S]``.
        other_mean: of the second.
        other_cov: of the second.

    Returns:
        The mean ``[*B, S]`` and the covariance ``[*B, S, S]``.

    Examples:
        >>> one = torch.ones(1)
        >>> mix_moments(0.5 * one, 2 * one, torch.eye(1), 0 * one, torch.eye(1))  # two peaks, one from the middle each
        (tensor([1.]), tensor([[2.]]))
    """
    apart, q = mean - other_mean, share.unsqueeze(-1)
    between = apart.unsqueeze(-1) * apart.unsqueeze(-2)
    return other_mean + share * apart, other_cov + q * (cov - other_cov) + q * (1 - q) * between


def mix_members(share: Tensor, members: Tensor, other: Tensor) -> Tensor:
    r"""Returns an ensemble with the mean and the sample covariance of a mixture of two ensembles of the same members.

    Each member first goes the share q of its way from the other place to its own. What that lacks of the mixture's
    covariance is the doubt where on its way a member is, :math:`q (1 - q) \Delta^T \Delta / (E - 1)` with
    :math:`\Delta` the ways, E x S. The anomalies :math:`A_0` are therefore multiplied by :math:`L_0^{-T} L^T`, with
    :math:`L_0 L_0^T = A_0^T A_0` and L the factor of what is to come out: :math:`A^T A = L L^T`. That asks for at most
    E - 1 directions in which the members differ, as updates without localisation leave them; where there are more, the
    ensemble cannot hold the mixture. No component depends on one behind it, so that a lag window behind the present
    leaves the present as it is. It costs about :math:`S^3 + E S^2`, in double precision.

    Args:
        share: q, of the first, ``[*B, 1]``; with 1 the first comes out, with 0 the second, to rounding.
        members: ``[*B, E, S]``.
        other: ``[*B, E, S]``.

    Returns:
        ``[*B, E, S]``.

    Examples:
        >>> up, down = torch.tensor([[1.0], [3.0]]), torch.tensor([[-3.0], [-1.0]])
        >>> mixed = mix_members(torch.tensor([0.5]), up, down)
        >>> mixed.mean().round(decimals=3), mixed.var().round(decimals=3)  # 2 within, and 4 between
        (tensor(0.), tensor(6.))
    """
    size, q = members.shape[-2], share.unsqueeze(-1)
    mean, other_mean = members.mean(-2, keepdim=True), other.mean(-2, keepdim=True)
    anomalies, apart = other - other_mean, mean - other_mean
    change = (members - mean) - anomalies
    base = (anomalies + q * change).double()
    # E - 1 times the squared way of the mean, as a sample covariance counts it.
    ways = torch.cat([change, math.sqrt(size - 1) * apart], -2).double()
    gram, doubt = base.mT @ base, (q * (1 - q)).double() * (ways.mT @ ways)
    whole = gram + doubt
    scale = whole.diagonal(dim1=-2, dim2=-1).detach().clamp_min(0).sqrt()
    inverse = torch.where(scale > 0, 1 / torch.where(scale > 0, scale, 1), 0)
    unit = inverse.unsqueeze(-1) * inverse.unsqueeze(-2)
    # As much as rounding leaves of directions in which the members do not differ, lest others are found in there.
    ridge = max(_RIDGE, torch.finfo(members.dtype).eps) * torch.eye(
        scale.shape[-1], dtype=scale.dtype, device=scale.device
    )
    first, wanted = cholesky(unit * gram + ridge), cholesky(unit * whole + ridge)
    scaled = torch.linalg.solve_triangular(first, (inverse.unsqueeze(-2) * base).mT, upper=False)
    return other_mean + q * apart + (scale.unsqueeze(-2) * (scaled.mT @ wanted.mT)).to(members.dtype)
