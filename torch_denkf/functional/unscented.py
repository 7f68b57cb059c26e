"""The unscented transform: passes 2 S + 1 sigma points of a Gaussian through a function, without its Jacobian.

Source: Julier & Uhlmann 2004, "Unscented filtering and nonlinear estimation", Proc. IEEE 92; Wan & van der Merwe 2000
for alpha, beta and kappa; Särkkä 2013, section 5.5.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf._checks import check_ensemble, check_one_dtype, check_shape
from torch_denkf.functional.gaussian import GaussianUpdate, _check_moments, hide, solve_for_gain
from torch_denkf.functional.linalg import as_covariance, semidefinite_root
from torch_denkf.functional.manifolds import Space, check_space


class UnscentedWeights(NamedTuple):
    """Weights of 2 S + 1 sigma points, ``[2 S + 1]`` each.

    Attributes:
        mean: weights of the mean, which sum to one.
        cov: weights of the covariance.
    """

    mean: Tensor
    cov: Tensor


def unscented_weights(
    dim: int,
    *,
    alpha: float = 1.0,
    beta: float = 0.0,
    kappa: float = 0.5,
    dtype: torch.dtype | None = None,
    device: torch.device | None = None,
) -> UnscentedWeights:
    r"""Returns sigma points' weights for a Gaussian (Särkkä 2013, eq. 5.77), with :math:`c = \alpha^2 (S + \kappa)`.

    Moments up to the third are exact for any values. With ``alpha=1, kappa=2-S, beta=1`` the covariance of a sum of
    squares is exact, too. With ``alpha=1, beta=0`` (default) all weights are positive where ``kappa`` is, and
    covariances then stay positive; ``kappa=0`` is the cubature filter.

    Args:
        dim: S.
        alpha: spread of the points.
        beta: extra weight of the central point in the covariance.
        kappa: second scaling parameter of the spread.
        dtype: dtype of the weights.
        device: device of the weights.

    Raises:
        ValueError: if c is not positive.

    Examples:
        >>> unscented_weights(2, kappa=1.0).mean
        tensor([0.3333, 0.1667, 0.1667, 0.1667, 0.1667])
    """
    spread = _spread(dim, alpha, kappa)
    center = torch.arange(2 * dim + 1, device=device) == 0
    weights = torch.full((2 * dim + 1,), 0.5 / spread, dtype=dtype, device=device)
    mean = torch.where(center, (spread - dim) / spread, weights)
    return UnscentedWeights(mean, torch.where(center, (spread - dim) / spread + 1 - alpha**2 + beta, weights))


def sigma_points(mean: Tensor, cov: Tensor, *, alpha: float = 1.0, kappa: float = 0.5) -> Tensor:
    r"""Returns the mean, and :math:`m \pm \sqrt{c}` times the columns of a root of P (Särkkä 2013, eq. 5.74).

    The covariance may be singular. A component of zero variance has exactly the mean's value in all points. Two
    components count as fully correlated if their correlation is within 10 S times the machine precision of one.
    Variances are reproduced to rounding. Gradients are finite; for a component of zero variance ``cov`` has none.

    Args:
        mean: m, ``[*B, S]``.
        cov: P, symmetric, positive semi-definite, ``[*B, S, S]``.
        alpha: spread of the points.
        kappa: second scaling parameter of the spread.

    Returns:
        The points, ``[*B, 2 S + 1, S]``, the mean first; NaN where P has a clearly negative eigenvalue.

    Raises:
        ValueError: if shapes do not fit, or c is not positive.

    Examples:
        >>> sigma_points(torch.zeros(1), 4 * torch.eye(1), kappa=0.0).flatten()
        tensor([ 0.,  2., -2.])
    """
    _check_moments(mean, cov)
    check_one_dtype(mean=mean, cov=cov)
    columns = math.sqrt(_spread(mean.shape[-1], alpha, kappa)) * semidefinite_root(cov).mT
    center = mean.unsqueeze(-2)
    return torch.cat([center, center + columns, center - columns], -2)


def unscented_moments(
    points: Tensor, weights: UnscentedWeights, *, space: Space | None = None
) -> tuple[Tensor, Tensor]:
    """Returns mean and covariance of sigma points that a function has mapped (Särkkä 2013, eq. 5.75).

    Args:
        points: ``[*B, 2 S + 1, N]``.
        weights: see :func:`unscented_weights`.
        space: space of numbers and angles, if some are angles: they are averaged as differences to the central point.
            ``None`` for plain numbers.

    Returns:
        The mean ``[*B, N]`` and the covariance ``[*B, N, N]``.

    Raises:
        ValueError: if there are not as many points as weights, or for another space.

    Examples:
        >>> points = sigma_points(torch.zeros(1), torch.eye(1))
        >>> mean, cov = unscented_moments(points**2, unscented_weights(1, kappa=0.5))
        >>> mean.round(decimals=4)  # E x^2
        tensor([1.])
    """
    mean, deviations = _deviations(points, weights, space)
    return mean, _weighted_gram(deviations, weights.cov)


def unscented_anomalies(points: Tensor, images: Tensor, weights: UnscentedWeights) -> tuple[Tensor, Tensor, Tensor]:
    r"""Returns the anomalies of a state and of a function of it, from sigma points (Särkkä 2013, eq. 5.75).

    Args:
        points: sigma points of the state, ``[*B, 2 S + 1, S]``.
        images: values of the function at the points, ``[*B, 2 S + 1, N]``.
        weights: see :func:`unscented_weights`.

    Returns:
        A ``[*B, S, 2 S + 1]``, W ``[2 S + 1, 2 S + 1]`` and B ``[*B, N, 2 S + 1]``: the state's covariance is
        :math:`A W A^T`, the covariance of state and function :math:`A W B^T`.

    Raises:
        ValueError: if there are not as many points as weights.

    Examples:
        >>> points = sigma_points(torch.zeros(1), torch.eye(1))
        >>> before, weights, after = unscented_anomalies(points, 3 * points, unscented_weights(1))
        >>> (before @ weights @ after.mT).round(decimals=4)
        tensor([[3.]])
    """
    # The points are symmetric about their mean, so centring the values does not change W B^T; it only saves digits.
    deviations = _deviations(images, weights, None)[1]
    return (points - points[..., :1, :]).mT, weights.cov.diag_embed(), deviations.mT


def unscented_update(
    points: Tensor,
    predicted: Tensor,
    observation: Tensor,
    noise: Tensor,
    weights: UnscentedWeights,
    *,
    observed: Tensor | None = None,
    space: Space | None = None,
) -> GaussianUpdate:
    r"""Conditions a Gaussian on an observation, by its sigma points (Särkkä 2013, eqs. 5.86 and 5.87).

    The covariance is :math:`\sum_i w_i (\delta x_i - K \delta y_i)(\cdot)^T + K R K^T`, Joseph's form in points: where
    no weight is negative, round-off leaves it positive.

    Args:
        points: sigma points of the prior, ``[*B, 2 S + 1, S]``.
        predicted: predicted observation of each point, h(point), ``[*B, 2 S + 1, O]``.
        observation: y, ``[*B, O]``.
        noise: R, variances ``[*B, O]`` or covariances ``[*B, O, O]``.
        weights: see :func:`unscented_weights`.
        observed: mask ``[*B, 1]`` or ``[*B, O]``, see :func:`torch_denkf.functional.kalman_update`.
        space: space of the observation, made of numbers and angles; ``None`` for plain numbers.

    Returns:
        A :class:`torch_denkf.functional.gaussian.GaussianUpdate`.

    Raises:
        ValueError: if shapes do not fit.

    Examples:
        >>> points = sigma_points(torch.zeros(1), torch.eye(1))
        >>> one = torch.ones(1)
        >>> update = unscented_update(points, points, 2 * one, one, unscented_weights(1))
        >>> update.mean, update.cov
        (tensor([1.0000]), tensor([[0.5000]]))
    """
    check_one_dtype(points=points, predicted=predicted, observation=observation, noise=noise)
    expected, deviations = _deviations(predicted, weights, space)
    check_ensemble("points", points)
    batch, dim = expected.shape[:-1], expected.shape[-1]
    check_shape("points", points, (*batch, len(weights.mean), points.shape[-1]), "[*B, 2 S + 1, S]")
    check_shape("observation", observation, (*batch, dim), "[*B, O]")
    if noise.ndim == expected.ndim:
        check_shape("noise", noise, (*batch, dim), "variances [*B, O]")
        noise = as_covariance(noise, expected)
    else:
        check_shape("noise", noise, (*batch, dim, dim), "variances [*B, O] or covariances [*B, O, O]")
    innovation = observation - expected if space is None else space.minus(observation, expected)
    count: int | Tensor = dim
    if observed is not None:
        observed, noise, count = hide(observed, noise, (*batch, dim))
        innovation = torch.where(observed, innovation, 0)
        deviations = torch.where(observed.unsqueeze(-2), deviations, 0)
    mean = points[..., 0, :]
    anomalies = points - mean.unsqueeze(-2)
    cross = deviations.mT @ (weights.cov.unsqueeze(-1) * anomalies)
    predicted_cov = _weighted_gram(deviations, weights.cov) + noise
    gain, nis, log_det = solve_for_gain(predicted_cov, cross, innovation)
    remaining = anomalies - deviations @ gain.mT
    cov = _weighted_gram(remaining, weights.cov) + gain @ noise @ gain.mT
    mean = mean + (gain @ innovation.unsqueeze(-1)).squeeze(-1)
    log_likelihood = -0.5 * (nis + log_det + count * math.log(2 * math.pi))
    return GaussianUpdate(mean, (cov + cov.mT) / 2, innovation, nis, log_likelihood)


def _spread(dim: int, alpha: float, kappa: float) -> float:
    spread = alpha**2 * (dim + kappa)
    if not spread > 0:
        raise ValueError(
            f"sigma points need alpha^2 (S + kappa) > 0; got alpha={alpha}, kappa={kappa} and S={dim}. Use kappa >= 0."
        )
    return spread


def _deviations(points: Tensor, weights: UnscentedWeights, space: Space | None) -> tuple[Tensor, Tensor]:
    """Returns weighted mean ``[*B, N]`` and deviations ``[*B, 2 S + 1, N]``, by differences to the central point."""
    check_ensemble("points", points)
    if points.shape[-2] != len(weights.mean):
        raise ValueError(
            f"there are {points.shape[-2]} points in shape {list(points.shape)} and {len(weights.mean)} weights; "
            "points are [*B, 2 S + 1, N], and the weights must be for S dimensions"
        )
    center = points[..., :1, :]
    space = check_space("space", space, flat=True)
    deviations = points - center if space is None else space.minus(points, center)
    shift = (weights.mean.unsqueeze(-1) * deviations).sum(-2)
    return center.squeeze(-2) + shift, deviations - shift.unsqueeze(-2)


def _weighted_gram(rows: Tensor, weights: Tensor) -> Tensor:
    gram = rows.mT @ (weights.unsqueeze(-1) * rows)
    return (gram + gram.mT) / 2
