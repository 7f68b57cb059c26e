"""Consistency of a Gaussian belief: the normalised estimation error squared (NEES) and its bounds."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import Space
from torch_denkf.metrics.state import check_level, state_difference

__all__ = ["NEES", "nees"]


class NEES(NamedTuple):
    """Holds the results of :func:`nees`; ``*M`` are the batch dims that remain after averaging.

    Attributes:
        mean: mean NEES, ``[*M]``; S for a consistent filter.
        lower: bound below which the filter is underconfident: its covariance is larger than its errors.
        upper: bound above which the filter is overconfident: its covariance is smaller than its errors.
        values: NEES of each state, ``[*B]``.
    """

    mean: Tensor
    lower: float
    upper: float
    values: Tensor


def nees(
    mean: Tensor,
    covariance: Tensor,
    truth: Tensor,
    *,
    space: Space | None = None,
    level: float = 0.95,
    dim: int | None = None,
) -> NEES:
    r"""Returns the normalised estimation error squared :math:`e^\top P^{-1} e`, its mean, and bounds of the mean.

    The sum over N independent errors that fit their covariance is chi-square distributed with N S degrees of freedom,
    so that the mean lies between ``lower`` and ``upper`` with probability ``level``. The errors of one run at
    successive steps are not independent, and bounds over them are too narrow: average over runs at each step
    (``dim=0`` of ``[runs, T, S]``).

    With the sample covariance of E members the mean of a calibrated ensemble is not S but
    S (E+1)(E-1) / (E (E-S-2)), because the inverse of a sample covariance is too large.

    Args:
        mean: ``[*B, S]``.
        covariance: P, ``[*B, S, S]``, or the variances ``[*B, S]`` if the errors are uncorrelated.
        truth: ``[*B, S]``, in the same units.
        space: the space of mean and truth, points ``[*B, P]``; the covariance is then of the S-dimensional tangents at
            the mean. ``None`` for vectors.
        level: probability of the bounds.
        dim: batch dimension to average over; all of them by default.

    Returns:
        A :class:`NEES`.

    Raises:
        ValueError: if the shapes do not fit, if a covariance is not positive definite (the covariance of fewer than
            S + 1 members never is), if ``level`` is not in (0, 1), if the truth is NaN, or if there are no errors.

    Source:
        Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", section 5.4.2.

    Examples:
        >>> import torch
        >>> truth = torch.tensor([[2.0, 0.0], [0.0, 1.0]])
        >>> result = nees(torch.zeros(2, 2), torch.eye(2).expand(2, 2, 2), truth)
        >>> result.values.tolist(), result.mean.item(), round(result.lower, 3), round(result.upper, 3)
        ([4.0, 1.0], 2.5, 0.242, 5.572)
    """
    check_level(level)
    if bool(truth.isnan().any()):
        raise ValueError("the truth is NaN, unknown, in some places; leave out these rows")
    error = state_difference(mean, truth, space=space)
    scale = _scale(error, covariance)
    if covariance.ndim == error.ndim:
        whitened = error / scale
    else:
        whitened = torch.linalg.solve_triangular(scale, error.unsqueeze(-1), upper=False).squeeze(-1)
    values = whitened.square().sum(-1)
    count = values.numel() if dim is None else values.shape[dim]
    if count == 0:
        raise ValueError(f"there are no errors to average over, got {list(truth.shape)}")
    freedom = count * error.shape[-1]
    lower, upper = (_chi_square_quantile(p, freedom) / count for p in ((1 - level) / 2, (1 + level) / 2))
    return NEES(values.mean() if dim is None else values.mean(dim), lower, upper, values)


def _scale(error: Tensor, covariance: Tensor) -> Tensor:
    """Returns standard deviations ``[*B, S]``, or the Cholesky factor ``[*B, S, S]``."""
    if covariance.shape == error.shape:
        if not bool((covariance > 0).all()):
            raise ValueError(f"variances must be positive; the least is {covariance.min().item():.3g}")
        return covariance.sqrt()
    if covariance.shape != (*error.shape, error.shape[-1]):
        raise ValueError(
            f"covariance must be [*B, S, S] = {[*error.shape, error.shape[-1]]}, or variances [*B, S] = "
            f"{list(error.shape)}; got {list(covariance.shape)}"
        )
    factor, failed = torch.linalg.cholesky_ex(covariance)
    if bool(failed.any()):
        raise ValueError(
            f"{int((failed > 0).sum())} of {failed.numel()} covariances are not positive definite; an ensemble needs "
            f"more than S = {error.shape[-1]} members, or pass its variances [*B, S]"
        )
    return factor


def _chi_square_quantile(p: float, freedom: int) -> float:
    """Inverts the distribution function, the regularised lower incomplete gamma function, by bisection."""
    half = torch.tensor(freedom / 2, dtype=torch.float64)
    low, high = 0.0, freedom + 20.0 * (2 * freedom) ** 0.5 + 100.0  # beyond 1 - 1e-15 for any freedom
    for _ in range(100):
        middle = (low + high) / 2
        below = torch.special.gammainc(half, torch.tensor(middle / 2, dtype=torch.float64)).item() < p
        low, high = (middle, high) if below else (low, middle)
    return (low + high) / 2
