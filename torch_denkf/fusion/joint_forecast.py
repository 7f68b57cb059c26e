"""Forecast of the joint Gaussian of the present state and the last L states."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.smoothing.rts import smoothing_gain


def joint_forecast(
    mean: Tensor, cov: Tensor, cross: Tensor, joint_mean: Tensor, joint_cov: Tensor, *, unmoved: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Predicts a joint Gaussian of L + 1 states by one step, and drops its oldest state.

    The forecast depends on the lag window only through the last state: its covariance with an earlier state is G^T
    times the covariance of the last and the earlier state, with the smoother's gain G (Särkkä 2013, section 8.2). Means
    may be points of a space; covariances are then of tangents.

    Args:
        mean: mean of the forecast, ``[*B, S]``, in the state's units.
        cov: covariance of the forecast, ``[*B, S, S]``.
        cross: cross-covariance of the last state (rows) and the forecast, ``[*B, S, S]``.
        joint_mean: mean of the L + 1 previous states, the latest first, ``[*B, (L + 1) S]``.
        joint_cov: their covariance, ``[*B, (L + 1) S, (L + 1) S]``.
        unmoved: mask ``[*B, 1]`` of rows whose forecast equals the last state; ``None`` for none.

    Returns:
        Mean and covariance of the forecast and the L states before it.

    Examples:
        A random walk with variance 1, a step of variance 2.

        >>> one = torch.ones(1, 1)
        >>> mean, cov = joint_forecast(one[0], 3 * one, one, torch.zeros(2), torch.ones(2, 2))
        >>> cov
        tensor([[3., 1.],
                [1., 1.]])
    """
    size = cov.shape[-1]
    past_mean, past_cov = joint_mean[..., : -mean.shape[-1]], joint_cov[..., :-size, :-size]
    last = past_cov[..., :size, :size]
    start = None if unmoved is None else unmoved.unsqueeze(-1)
    cross = (cross if start is None else torch.where(start, last, cross)).mT
    gain = smoothing_gain(cross, last)
    if start is not None:
        gain = torch.where(start, torch.eye(size, dtype=mean.dtype, device=mean.device), gain)
    between = torch.cat([cross, gain @ past_cov[..., :size, size:]], -1)
    joint = torch.cat([torch.cat([cov, between], -1), torch.cat([between.mT, past_cov], -1)], -2)
    return torch.cat([mean, past_mean], -1), joint
