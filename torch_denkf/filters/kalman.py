"""The exact filter of linear-Gaussian systems: the oracle of all others, on the same base."""

from __future__ import annotations

from collections import OrderedDict

import torch
from tensordict import NestedKey

from torch_denkf.filters.base import Filter
from torch_denkf.modules import KalmanAnalysis, LinearTransition, MomentPrior

__all__ = ["KalmanFilter"]


class KalmanFilter(Filter):
    r"""Kalman filter of :math:`x_t = F x_{t-1} + N(0, Q)`, :math:`y_t = H x_t + N(0, R)`.

    Its belief is ``("belief", "mean")`` ``[*B, S]`` and ``("belief", "cov")`` ``[*B, S, S]``, with the variances in
    ``("belief", "var")``.

    Args:
        transition: F, ``[S, S]``.
        transition_noise: Q, ``[S, S]``.
        observation: H, ``[O, S]``.
        observation_noise: R, ``[O]`` variances or ``[O, O]``.
        mean: of the initial belief, ``[S]``.
        cov: of the initial belief, ``[S, S]``.
        observation_key: readings ``[*B, O]``.
        update_at_reset: whether the initial belief is updated with the first reading.

    Example:
        >>> from tensordict import TensorDict
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, 0 * one, one, one, mean=torch.zeros(1), cov=one)
        >>> td = kf.initialise(TensorDict({"observation": torch.ones(1)}))
        >>> kf.step(td)["belief", "mean"]
        tensor([0.5000])
    """

    def __init__(
        self,
        transition: torch.Tensor,
        transition_noise: torch.Tensor,
        observation: torch.Tensor,
        observation_noise: torch.Tensor,
        *,
        mean: torch.Tensor,
        cov: torch.Tensor,
        observation_key: NestedKey = "observation",
        update_at_reset: bool = False,
    ):
        modules = OrderedDict(
            transition=LinearTransition(transition, transition_noise),
            analysis=KalmanAnalysis(observation, observation_noise, observation_key=observation_key),
        )
        super().__init__(modules, initial=MomentPrior(mean, cov), update_at_reset=update_at_reset)
