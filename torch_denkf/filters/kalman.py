"""The exact filter of linear-Gaussian systems: the oracle of all others, on the same base."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, Unpack

import torch
from tensordict import NestedKey

from torch_denkf._checks import check_covariance, check_shape, check_square, check_values
from torch_denkf.filters._options import FilterOptions
from torch_denkf.filters.base import Filter
from torch_denkf.modules import KalmanAnalysis, LinearTransition, MomentPrior
from torch_denkf.modules._tensors import as_floating, check_dims

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
        control: B, ``[S, A]``, of the action; ``None`` for none.
        angles: components of the observation that are angles in radians.
        observation_key: readings ``[*B, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``.
        **kwargs: ``control_keys``, of which the first drives the transition where ``control`` is given, ``init_key``,
            ``update_at_reset``, ``variance_ceiling``, ``check_finite`` and ``reject`` of :class:`Filter`.

    Raises:
        ValueError: if the shapes do not fit, a number is not finite, or Q, R or ``cov`` is no covariance.

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
        control: torch.Tensor | None = None,
        angles: Sequence[int] = (),
        observation_key: NestedKey = "observation",
        observed_key: NestedKey = "observed",
        **kwargs: Unpack[FilterOptions],
    ):
        f, q, h, r, m, p = map(as_floating, (transition, transition_noise, observation, observation_noise, mean, cov))
        check_square("transition", f)
        size, readings = len(f), len(h) if h.ndim else 0
        check_shape("observation", h, (readings, size), "[O, S]")
        check_shape("mean", m, (size,), "[S]")
        for name, value in {"transition": f, "observation": h, "mean": m}.items():
            check_values(name, value)
        check_covariance("transition_noise", q, size)
        check_covariance("cov", p, size)
        if r.ndim == 2:
            check_covariance("observation_noise", r, readings, "[O] or [O, O]")
        else:
            check_shape("observation_noise", r, (readings,), "[O]")
            check_values("observation_noise", r, least=0, cure="These are variances")
        if control is not None:
            b = as_floating(control)
            check_shape("control", b, (size, b.shape[-1] if b.ndim else 0), "[S, A]")
            check_values("control", b)
        check_dims("angles", angles, readings)
        action: dict[str, Any] = {}
        if control is not None:
            action = {"control": control, "action_key": kwargs.get("control_keys", ("action",))[0]}
        modules = OrderedDict(
            transition=LinearTransition(transition, transition_noise, **action),
            analysis=KalmanAnalysis(
                observation,
                observation_noise,
                observation_key=observation_key,
                observed_key=observed_key,
                angles=angles,
            ),
        )
        super().__init__(modules, initial=MomentPrior(mean, cov), **kwargs)
