"""The Kalman filter's two steps on a mean and a covariance: the reference of the ensemble filters, and the
linear algebra of the extended Kalman filter, whose matrices are Jacobians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from torch_denkf._checks import check_observed, check_one_dtype, check_shape, check_shapes
from torch_denkf.functional.kernels.small_system import WrittenOut, is_written_out
from torch_denkf.functional.linalg import Solver, as_covariance


class GaussianUpdate(NamedTuple):
    """Holds the results of :func:`kalman_update`.

    Attributes:
        mean: posterior mean, ``[*B, S]``, in the state's units.
        cov: posterior covariance, symmetric, ``[*B, S, S]``.
        innovation: observation minus predicted observation, ``[*B, O]``; 0 where unobserved.
        nis: innovationᵀ S⁻¹ innovation over the observed components, ``[*B, 1]``.
        log_likelihood: log N(innovation; 0, S) over the observed components, ``[*B, 1]``; 0 where nothing
            is observed.
    """

    mean: Tensor
    cov: Tensor
    innovation: Tensor
    nis: Tensor
    log_likelihood: Tensor


def kalman_predict(mean: Tensor, cov: Tensor, transition: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Forecasts a Gaussian through a linear transition: F m and F P Fᵀ + Q (Särkkä 2013, eq. 4.20).

    Args:
        mean: m, ``[*B, S]``, in the state's units.
        cov: P, ``[*B, S, S]``.
        transition: F, ``[S, S]`` or ``[*B, S, S]``.
        noise: covariance Q of the process noise, ``[S, S]`` or ``[*B, S, S]``.

    Returns:
        The mean ``[*B, S]`` and covariance ``[*B, S, S]`` of the forecast.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> mean, cov = torch.tensor([0.0, 1.0]), torch.eye(2)
        >>> kalman_predict(mean, cov, torch.tensor([[1.0, 0.5], [0.0, 1.0]]), torch.zeros(2, 2))
        (tensor([0.5000, 1.0000]), tensor([[1.2500, 0.5000],
                [0.5000, 1.0000]]))
    """
    square = cov.shape[-2:]
    plain = mean.dtype == cov.dtype == transition.dtype == noise.dtype and transition.shape == noise.shape == square
    if not (plain and mean.ndim and cov.shape == (*mean.shape, mean.shape[-1])):
        check_one_dtype(mean=mean, cov=cov, transition=transition)
        _check_moments(mean, cov, noise)
        check_shapes(
            ("transition", transition, square if transition.ndim == 2 else cov.shape, "[S, S] or [*B, S, S]"),
            ("noise", noise, square if noise.ndim == 2 else cov.shape, "[S, S] or [*B, S, S]"),
        )
    return _apply(transition, mean), sandwich(transition, cov) + noise


def kalman_update(
    mean: Tensor,
    cov: Tensor,
    observation: Tensor,
    observation_matrix: Tensor,
    noise: Tensor,
    *,
    observed: Tensor | None = None,
) -> GaussianUpdate:
    """Conditions a Gaussian on a linear observation (Särkkä 2013, eq. 4.21).

    The covariance has Joseph's form, (I − KH) P (I − KH)ᵀ + K R Kᵀ, which stays positive under round-off. For an
    extended Kalman filter pass H = the Jacobian of h at the mean and ``observation - h(mean) + H @ mean``.

    Args:
        mean: prior mean m, ``[*B, S]``, in the state's units.
        cov: prior covariance P, ``[*B, S, S]``.
        observation: y, ``[*B, O]``, in the sensor's units.
        observation_matrix: H, ``[O, S]`` or ``[*B, O, S]``.
        noise: R: variances, ``[*B, O]``, or covariances, ``[*B, O, O]``.
        observed: boolean, ``[*B, 1]`` or ``[*B, O]``; components with False are left out of the update, whatever the
            values of their observation and noise, NaN included. None: everything is observed.

    Returns:
        A :class:`GaussianUpdate`; all NaN for batch elements whose S is not positive definite, or that have a
            negative variance in R.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> one = torch.ones(1)
        >>> update = kalman_update(0 * one, torch.eye(1), 2 * one, torch.eye(1), one)
        >>> update.mean, update.cov
        (tensor([1.]), tensor([[0.5000]]))
    """
    check_update(mean, cov, observation, observation_matrix, noise)
    innovation = observation - _apply(observation_matrix, mean)
    update = innovation_update(cov, innovation, observation_matrix, noise, observed=observed)
    return update._replace(mean=mean + update.mean)


def innovation_update(
    cov: Tensor, innovation: Tensor, observation_matrix: Tensor, noise: Tensor, *, observed: Tensor | None = None
) -> GaussianUpdate:
    """Updates like :func:`kalman_update`, for a prior mean of zero; checks the mask only.

    In deviations from the mean, H m loses no digits for states far from zero.
    """
    batch, dim = innovation.shape[:-1], innovation.shape[-1]
    if noise.ndim == innovation.ndim:
        noise = as_covariance(noise, innovation)
    noise = noise.to(cov.dtype)
    count: int | Tensor = dim
    if observed is not None:
        observed, noise, count = hide(observed, noise, (*batch, dim))
        innovation = torch.where(observed, innovation, 0)
        observation_matrix = torch.where(observed.unsqueeze(-1), observation_matrix, 0)

    p, h, r = cov, observation_matrix.expand(*batch, dim, cov.shape[-1]), innovation
    if len(batch) != 1:  # bmm with one batch dimension takes a third of the time
        p, h, noise = [value.reshape(-1, *value.shape[-2:]) for value in (p, h, noise.expand(*batch, dim, dim))]
        r = innovation.reshape(-1, dim)
    cross = torch.bmm(h, p)
    gain, nis, log_det = solve_for_gain(torch.baddbmm(noise, cross, h.mT), cross, r)
    keep = torch.baddbmm(torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device), gain, h, alpha=-1)
    half = torch.bmm(torch.bmm(gain, noise), gain.mT)
    half = torch.baddbmm(half, torch.bmm(keep, p), keep.mT, beta=0.5, alpha=0.5)
    mean, new = torch.bmm(gain, r.unsqueeze(-1)).squeeze(-1), half + half.mT
    if len(batch) != 1:
        mean, new, nis, log_det = [value.reshape(*batch, *value.shape[1:]) for value in (mean, new, nis, log_det)]
    log_likelihood = torch.rsub(nis + log_det, -0.5 * math.log(2 * math.pi) * count, alpha=0.5)
    return GaussianUpdate(mean, new, innovation, nis, log_likelihood)


def hide(observed: Tensor, noise: Tensor, shape: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Returns a mask of each component, R ``[*B, O, O]`` with the identity for unobserved ones, and the observed count.

    Args:
        observed: ``[*B, 1]`` or ``[*B, O]``.
        noise: R, ``[*B, O, O]``.
        shape: ``[*B, O]``.

    Raises:
        ValueError: if the mask has another shape, or is not boolean.
    """
    check_observed(observed, shape[:-1], shape[-1])
    observed = observed.expand(shape)
    identity = torch.eye(shape[-1], dtype=noise.dtype, device=noise.device)
    noise = torch.where(observed.unsqueeze(-1) & observed.unsqueeze(-2), noise, identity)
    return observed, noise, observed.sum(-1, keepdim=True, dtype=noise.dtype)


def check_update(mean: Tensor, cov: Tensor, observation: Tensor, matrix: Tensor, noise: Tensor) -> None:
    """Checks the arguments of :func:`kalman_update`."""
    batch, size, dim = mean.shape[:-1], mean.shape[-1:], observation.shape[-1:]
    noise_shape = (*batch, *dim) if noise.ndim == mean.ndim else (*batch, *dim, *dim)
    plain = mean.dtype == cov.dtype == observation.dtype == matrix.dtype == noise.dtype
    fits = observation.shape == (*batch, *dim) and matrix.shape[-2:] == (*dim, *size) and noise.shape == noise_shape
    if plain and fits and size and cov.shape == (*batch, *size, *size) and matrix.shape[:-2] in ((), batch):
        return
    check_one_dtype(mean=mean, cov=cov, observation=observation, observation_matrix=matrix)
    _check_moments(mean, cov, noise)
    matrix_batch = () if matrix.ndim == 2 else batch
    check_shapes(
        ("observation", observation, (*batch, *dim), "[*B, O]"),
        ("observation_matrix", matrix, (*matrix_batch, *dim, *size), "[O, S] or [*B, O, S]"),
        ("noise", noise, noise_shape, "variances [*B, O] or covariances [*B, O, O]"),
    )


def gaussian_log_prob(value: Tensor, mean: Tensor, cov: Tensor) -> Tensor:
    """Returns the log-density of a Gaussian, log N(value; mean, cov), NaN if ``cov`` is not positive definite.

    Unlike ``torch.distributions.MultivariateNormal`` it never synchronises with the device.

    Args:
        value: ``[*B, S]``.
        mean: ``[*B, S]``, in the units of ``value``.
        cov: ``[*B, S, S]``.

    Returns:
        The log-densities, ``[*B]``, in nats.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> gaussian_log_prob(torch.zeros(2), torch.zeros(2), torch.eye(2))
        tensor(-1.8379)
    """
    _check_moments(mean, cov)
    check_one_dtype(mean=mean, cov=cov, value=value)
    check_shape("value", value, mean.shape, "[*B, S], as mean,")
    solver = Solver(cov)
    nis, log_det = solver.square((value - mean).unsqueeze(-1)), solver.log_det()
    return -0.5 * (nis + log_det + mean.shape[-1] * math.log(2 * math.pi)).squeeze(-1)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return F.linear(vector, matrix) if matrix.ndim == 2 else (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def sandwich(matrix: Tensor, cov: Tensor) -> Tensor:
    """Returns M P Mᵀ for M ``[N, S]`` or ``[*B, N, S]`` and P ``[*B, S, S]``."""
    if cov.ndim != 3:
        return matrix @ cov @ matrix.mT
    matrix = matrix.expand(len(cov), *matrix.shape[-2:])
    return torch.bmm(torch.bmm(matrix, cov), matrix.mT)


def solve_for_gain(matrix: Tensor, cross: Tensor, residual: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the gain Cᵀ M⁻¹ with the residual's covariance M, and the two terms of its likelihood.

    Args:
        matrix: M, ``[*B, O, O]``.
        cross: C, ``[*B, O, S]``.
        residual: r, ``[*B, O]``.

    Returns:
        Cᵀ M⁻¹, ``[*B, S, O]``; rᵀ M⁻¹ r and log det M, ``[*B, 1]`` each. NaN if M is not positive definite.
    """
    if matrix.shape[-1] == 1:
        total = torch.threshold(matrix, 0, torch.nan)
        of_one = total.squeeze(-1)
        return cross.mT / total, residual.square() / of_one, of_one.log()
    solver = (WrittenOut if is_written_out(matrix) else Solver)(matrix)
    return solver.solve(cross).mT, solver.square(residual.unsqueeze(-1)), solver.log_det()


def _check_moments(mean: Tensor, cov: Tensor, noise: Tensor | None = None) -> None:
    if mean.ndim < 1:
        raise ValueError("mean must be [*B, S], got a scalar; add the dimension with unsqueeze")
    check_shape("cov", cov, (*mean.shape, mean.shape[-1]), "[*B, S, S]")
    # Noise is only added, so it may have a lower precision.
    if noise is not None and torch.promote_types(mean.dtype, noise.dtype) != mean.dtype:
        check_one_dtype(mean=mean, noise=noise)
