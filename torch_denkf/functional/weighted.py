"""Moments and the CRPS of weighted particles: the ensemble's, where each member counts with its own weight."""

from __future__ import annotations

from torch import Tensor

from torch_denkf._checks import check_ensemble, check_one_dtype, check_shape


def weighted_mean(particles: Tensor, log_weights: Tensor) -> Tensor:
    """The mean of weighted particles, Σ wⁱ xⁱ.

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
    """The variance of weighted particles, E / (E − 1) Σ wⁱ (xⁱ − x̄)².

    The factor makes it :func:`ensemble_var` for equal weights. It does not follow the effective number of particles:
    1 / (1 − Σ w²) instead would blow up where one particle has nearly all the weight.

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


def crps_weighted(particles: Tensor, log_weights: Tensor, target: Tensor) -> Tensor:
    """Continuous ranked probability score of weighted particles: Σ wⁱ|xⁱ − y| − 1/2 Σ Σ wⁱwʲ|xⁱ − xʲ|.

    It is the score of the weighted empirical distribution (Gneiting & Raftery 2007, eq. 21), for equal weights
    ``crps_ensemble(..., fair=False)``; weights leave no fair variant. Sorting makes it O(E log E).

    Args:
        particles: X, ``[*B, E, S]``, in the state's units.
        log_weights: log wⁱ, normalised, ``[*B, E]``.
        target: the truth y, ``[*B, S]``, in the state's units.

    Returns:
        The scores, ``[*B, S]``, in the state's units.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> crps_weighted(torch.tensor([[0.0], [2.0]]), torch.tensor([0.75, 0.25]).log(), torch.tensor([0.0]))
        tensor([0.1250])
    """
    check_particles(particles, log_weights)
    check_shape("target", target, (*particles.shape[:-2], particles.shape[-1]), "[*B, S]")
    # Differences to the target before sorting: no digits are lost where the mean dwarfs the spread.
    error, order = (particles - target.unsqueeze(-2)).sort(-2)
    weight = log_weights.exp().unsqueeze(-1).expand_as(error).gather(-2, order)
    below = weight.cumsum(-2)  # the weight of all that is not above, itself included
    return (weight * (error.abs() - (2 * below - weight - 1) * error)).sum(-2)


def check_particles(particles: Tensor, log_weights: Tensor, min_size: int = 1) -> None:
    """Raise ``ValueError`` unless these are particles ``[*B, E, S]`` and their log-weights ``[*B, E]``."""
    check_ensemble("particles", particles, min_size)
    check_shape("log_weights", log_weights, particles.shape[:-1], "[*B, E]")
    check_one_dtype(particles=particles, log_weights=log_weights)
