"""Scores of errors: of members, and of a Gaussian. All objectives are made of these."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional import crps_ensemble, crps_gaussian, energy_score, gaussian_log_prob

__all__ = ["GAUSSIAN_SCORES", "MEMBER_SCORES", "score_gaussian", "score_members"]

MEMBER_SCORES = ("crps", "energy", "mse")
GAUSSIAN_SCORES = ("crps", "nll", "mse")


def score_members(errors: Tensor, score: str) -> Tensor:
    """Scores members that are off by ``errors``.

    One member is a point, and the CRPS of a point is its absolute error; the energy score is the length of its error.
    The fair scores of more members need pairs of them.

    Args:
        errors: ``[*, E, N]``, in the units of the score.
        score: ``"crps"``, fair, in each dimension, averaged; ``"energy"``, fair, of all dimensions together; ``"mse"``,
            the squared error of the mean.

    Returns:
        The scores, ``[*]``.

    Example:
        >>> score_members(torch.tensor([[-3.0]]), "crps"), score_members(torch.tensor([[-1.0], [1.0]]), "crps")
        (tensor(3.), tensor(0.))
    """
    if score == "mse":
        return errors.mean(-2).square().mean(-1)
    zero, fair = torch.zeros_like(errors[..., 0, :]), errors.shape[-2] > 1
    if score == "energy":
        return energy_score(errors, zero, fair=fair)
    return crps_ensemble(errors, zero, fair=fair).mean(-1)


def score_gaussian(errors: Tensor, cov: Tensor, score: str, scale: Tensor | None = None) -> Tensor:
    """Scores a Gaussian whose mean is off by ``errors``.

    Args:
        errors: ``[*, N]``, divided by ``scale``.
        cov: ``[*, N, N]``, in its own units.
        score: ``"crps"`` in each dimension, averaged; ``"nll"``, the negative log-density of all dimensions together,
            in nats, in their own units; ``"mse"`` of the mean.
        scale: ``[N]`` or one number; ``None`` for one.

    Returns:
        The scores, ``[*]``.

    Example:
        >>> score_gaussian(torch.zeros(1), torch.eye(1), "nll")
        tensor(0.9189)
    """
    if score == "mse":
        return errors.square().mean(-1)
    units: float | Tensor = 0.0
    if scale is not None:
        scale = scale.expand(errors.shape[-1])
        cov, units = cov / scale.unsqueeze(-1) / scale, scale.log().sum()
    zero = torch.zeros_like(errors)
    if score == "nll":
        # The density is that of the unscaled errors, so that the scale only conditions the arithmetic.
        return units - gaussian_log_prob(errors, zero, cov)
    # Without spread the CRPS is the absolute error; a spread of 1e-6 is as good as none, and has a derivative.
    variance = cov.diagonal(dim1=-2, dim2=-1).clamp(min=1e-12)
    return crps_gaussian(zero, variance, errors).mean(-1)
