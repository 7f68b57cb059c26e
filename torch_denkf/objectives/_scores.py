"""Scores of errors: of members, of weighted particles, and of a Gaussian. All objectives are made of these.

Errors are zero where there is no label; a score is of the components that have one.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_denkf.functional import crps_ensemble, crps_gaussian, crps_weighted, energy_score, gaussian_log_prob

__all__ = ["GAUSSIAN_SCORES", "MEMBER_SCORES", "mean_of", "score_gaussian", "score_members", "score_mixture"]

MEMBER_SCORES = ("crps", "energy", "mse")
GAUSSIAN_SCORES = ("crps", "nll", "mse")


def mean_of(values: Tensor, mask: Tensor) -> Tensor:
    """The mean over the last dimension of what a mask leaves in, ``[*]``; zero of nothing.

    Example:
        >>> mean_of(torch.tensor([1.0, 5.0]), torch.tensor([False, True]))
        tensor(5.)
    """
    return torch.where(mask, values, 0).sum(-1) / mask.sum(-1).clamp(min=1)


def score_members(errors: Tensor, mask: Tensor, score: str) -> Tensor:
    """Scores members that are off by ``errors``.

    One member is a point, and the CRPS of a point is its absolute error; the energy score is the length of its error.
    The fair scores of more members need pairs of them.

    Args:
        errors: ``[*, E, N]``, in the units of the score.
        mask: which components have a label, ``[*, N]``.
        score: ``"crps"``, fair, in each dimension, averaged; ``"energy"``, fair, of all dimensions together; ``"mse"``,
            the squared error of the mean.

    Returns:
        The scores, ``[*]``.

    Example:
        >>> score_members(torch.tensor([[-3.0]]), torch.tensor([True]), "crps")
        tensor(3.)
        >>> score_members(torch.tensor([[-1.0], [1.0]]), torch.tensor([True]), "crps")
        tensor(0.)
    """
    if score == "mse":
        return mean_of(errors.mean(-2).square(), mask)
    zero, fair = torch.zeros_like(errors[..., 0, :]), errors.shape[-2] > 1
    if score == "energy":
        return energy_score(errors, zero, fair=fair)
    return mean_of(crps_ensemble(errors, zero, fair=fair), mask)


def score_mixture(
    errors: Tensor, mask: Tensor, log_weights: Tensor, score: str, std: Tensor, scale: Tensor | None
) -> Tensor:
    """Scores weighted particles that are off by ``errors``.

    Args:
        errors: ``[*, E, N]``, divided by ``scale``.
        mask: which components have a label, ``[*, N]``.
        log_weights: ``[*, E]``.
        score: ``"mixture"``, the negative log-density of all dimensions together in their own units, with a Gaussian
            around each particle; ``"crps"`` with weights, in each dimension, averaged.
        std: width of these Gaussians, ``[N]``.
        scale: ``[N]``; ``None`` for one.

    Returns:
        The scores, ``[*]``.
    """
    if score == "crps":
        return mean_of(crps_weighted(errors, log_weights, torch.zeros_like(errors[..., 0, :])), mask)
    # In the state's own units the density is one of the scaled state, divided by all scales.
    width = std if scale is None else std * scale
    constant = torch.where(mask, width.log() + 0.5 * math.log(2 * math.pi), 0).sum(-1)
    log_density = log_weights - 0.5 * (errors / std).square().sum(-1)
    return constant - torch.logsumexp(log_density, -1)


def score_gaussian(errors: Tensor, mask: Tensor, cov: Tensor, score: str, scale: Tensor | None = None) -> Tensor:
    """Scores a Gaussian whose mean is off by ``errors``.

    Args:
        errors: ``[*, N]``, divided by ``scale``.
        mask: which components have a label, ``[*, N]``.
        cov: ``[*, N, N]``, in its own units.
        score: ``"crps"`` in each dimension, averaged; ``"nll"``, the negative log-density of all dimensions together,
            in nats, in their own units; ``"mse"`` of the mean.
        scale: ``[N]``; ``None`` for one.

    Returns:
        The scores, ``[*]``.

    Example:
        >>> score_gaussian(torch.zeros(2), torch.tensor([True, False]), torch.eye(2), "nll")
        tensor(0.9189)
    """
    if score == "mse":
        return mean_of(errors.square(), mask)
    if scale is not None:
        cov = cov / scale.unsqueeze(-1) / scale
    zero = torch.zeros_like(errors)
    if score == "nll":
        # Components without a label are made independent and standard normal; their density at zero is taken out
        # again. It is a density of the unscaled errors: the scale only conditions the arithmetic.
        identity = torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device)
        cov = torch.where(mask.unsqueeze(-1) & mask.unsqueeze(-2), cov, identity)
        units = zero if scale is None else scale.log().expand_as(errors)
        added = torch.where(mask, units, -0.5 * math.log(2 * math.pi))
        return added.sum(-1) - gaussian_log_prob(errors, zero, cov)
    # Without spread the CRPS is the absolute error; a spread of 1e-6 is as good as none, and has a derivative.
    variance = cov.diagonal(dim1=-2, dim2=-1).clamp(min=1e-12)
    return mean_of(crps_gaussian(zero, variance, errors), mask)
