"""Moments of weighted particles, in which each member has its own weight."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_ensemble, check_one_dtype, check_shape
from torch_denkf.functional.gaussian import solve_for_gain


def weighted_mean(particles: Tensor, log_weights: Tensor) -> Tensor:
    """Returns the mean of weighted particles, Σ wⁱ xⁱ.

    Args:
        particles: X, ``[*B, E, S]``, in the state's units.
        log_weights: log wⁱ, normalised, ``[*B, E]``.

    Returns:
        The means, ``[*B, S]``.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> weighted_mean(torch.tensor([[0.0], [4.0]]), torch.tensor([0.75, 0.25]).log())
        tensor([1.])
    """
    check_particles(particles, log_weights)
    return (log_weights.exp().unsqueeze(-2) @ particles).squeeze(-2)


def weighted_var(particles: Tensor, log_weights: Tensor) -> Tensor:
    """Returns the variance of weighted particles, E / (E − 1) Σ wⁱ (xⁱ − x̄)².

    With equal weights the factor makes it equal to :func:`ensemble_var`. It does not use the effective number of
    particles: 1 / (1 − Σ w²) would diverge if one particle has nearly all the weight.

    Args:
        particles: X, ``[*B, E, S]``, in the state's units.
        log_weights: log wⁱ, normalised, ``[*B, E]``.

    Returns:
        The variances, ``[*B, S]``, in the state's units squared.

    Raises:
        ValueError: if the shapes do not fit, or if there are fewer than two particles.

    Examples:
        >>> import torch
        >>> weighted_var(torch.tensor([[0.0], [4.0]]), torch.tensor([0.75, 0.25]).log())
        tensor([6.])
    """
    check_particles(particles, log_weights, min_size=2)
    anomalies = particles - weighted_mean(particles, log_weights).unsqueeze(-2)
    size = particles.shape[-2]
    return weighted_mean(anomalies.square(), log_weights) * (size / (size - 1))


def weighted_median(particles: Tensor, log_weights: Tensor) -> Tensor:
    """Returns the weighted median of each component: half of the weight is at or below it, as far as possible.

    Unlike the mean it stays near most of the weight if a few particles diverge.

    Args:
        particles: X, ``[*B, E, S]``, in the state's units.
        log_weights: log wⁱ, normalised, ``[*B, E]``.

    Returns:
        The medians, ``[*B, S]``: each is the component of a particle, the lower of two candidates.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> weighted_median(torch.tensor([[1.0], [2.0], [1e30]]), torch.tensor([0.4, 0.4, 0.2]).log())
        tensor([2.])
    """
    check_particles(particles, log_weights)
    ordered, order = particles.sort(-2)
    below = log_weights.exp().unsqueeze(-1).expand_as(particles).gather(-2, order).cumsum(-2)
    # Relative to the last sum, so that rounding cannot leave all sums below one half.
    index = (below < below[..., -1:, :] / 2).sum(-2, keepdim=True)
    return ordered.gather(-2, index).squeeze(-2)


def weighted_innovation(
    predicted: Tensor, log_weights: Tensor, observation: Tensor, noise: Tensor, *, observed: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Computes the innovation of weighted particles, its normalised square, and the log-determinant of its covariance.

    The innovation is y − Σ wⁱ h(xⁱ). Its covariance is R plus the covariance of the predicted observations, with the
    factor of :func:`weighted_var`. For a linear Gaussian system and many particles both equal the Kalman filter's.

    Args:
        predicted: h(xⁱ), ``[*B, E, O]``, in the sensor's units.
        log_weights: log wⁱ before the update, normalised, ``[*B, E]``.
        observation: y, ``[*B, O]``.
        noise: variances, the diagonal of R, ``[*B, O]``.
        observed: boolean, ``[*B, 1]`` or ``[*B, O]``; where it is False, observation and noise may be NaN.

    Returns:
        The innovation ``[*B, O]``, 0 where nothing was observed, and the NIS and the log-determinant, ``[*B, 1]``, over
        the observed components.

    Raises:
        ValueError: if the shapes do not fit, or if there are fewer than two particles.

    Examples:
        >>> particles, weights = torch.tensor([[-1.0], [1.0]]), torch.tensor([0.5, 0.5]).log()
        >>> innovation, nis, _ = weighted_innovation(particles, weights, torch.tensor([4.0]), torch.tensor([2.0]))
        >>> print(f"{innovation.item():.1f} {nis.item():.1f}")
        4.0 4.0
    """
    check_particles(predicted, log_weights, min_size=2)
    size, dim = predicted.shape[-2:]
    check_shape("observation", observation, (*predicted.shape[:-2], dim), "[*B, O]")
    mean = weighted_mean(predicted, log_weights)
    innovation, anomalies = observation - mean, predicted - mean.unsqueeze(-2)
    if observed is not None:
        innovation, noise = torch.where(observed, innovation, 0), torch.where(observed, noise, 1)
        anomalies = torch.where(observed.unsqueeze(-2), anomalies, 0)
    spread = (anomalies * log_weights.exp().unsqueeze(-1)).mT @ anomalies * (size / (size - 1))
    _, nis, log_det = solve_for_gain(spread + noise.diag_embed(), innovation.unsqueeze(-1), innovation)
    return innovation, nis, log_det


def check_particles(particles: Tensor, log_weights: Tensor, min_size: int = 1) -> None:
    """Raises ``ValueError`` unless these are particles ``[*B, E, S]`` and their log-weights ``[*B, E]``."""
    check_ensemble("particles", particles, min_size)
    check_shape("log_weights", log_weights, particles.shape[:-1], "[*B, E]")
    check_one_dtype(particles=particles, log_weights=log_weights)
