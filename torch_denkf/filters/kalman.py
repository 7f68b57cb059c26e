"""The exact filter of linear-Gaussian systems, a reference for all others, on the same base."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, Unpack

import torch
from tensordict import NestedKey

from torch_denkf._checks import check_covariance, check_one_dtype, check_shape, check_square, check_values
from torch_denkf.filters.base import Filter
from torch_denkf.filters.options import FilterOptions
from torch_denkf.filters.parts import SensorError, check_kind
from torch_denkf.functional.manifolds import Space
from torch_denkf.modules import KalmanAnalysis, LinearTransition, MomentPrior
from torch_denkf.modules.tensors import as_floating

__all__ = ["KalmanFilter"]


class KalmanFilter(Filter):
    r"""Kalman filter of :math:`x_t = F x_{t-1} + N(0, Q)`, :math:`y_t = H x_t + N(0, R)`.

    Its belief is ``("belief", "mean")`` ``[*B, S]`` and ``("belief", "cov")`` ``[*B, S, S]``, with the variances in
    ``("belief", "var")``.

    Args:
        transition: F, ``[S, S]``.
        observation: H, ``[O, S]``.
        process_noise: standard deviations of the process noise ``[S]``, in the state's units; or ``process_noise_cov``.
        process_noise_cov: Q, ``[S, S]``.
        noise: standard deviations of the readings ``[O]``, in their units; or ``noise_cov``.
        noise_cov: R, ``[O, O]``.
        mean: mean of the initial belief, ``[S]``.
        cov: covariance of the initial belief, ``[S, S]``.
        control: B, ``[S, A]``, the matrix of the action; ``None`` for none.
        reading_space: space of the reading, made of numbers and angles, such as ``Euclidean(1) * Circle()``;
            ``None`` for plain numbers.
        sensor_error: biases of the readings, :class:`~torch_denkf.imperfect.FadingBias`: they become part of
            the state, after its S components, with the present values of their parameters.
        observation_key: readings ``[*B, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``.
        **kwargs: ``control_keys``, of which the first drives the transition if ``control`` is given, ``init_key``,
            ``update_at_reset``, ``variance_ceiling``, ``check_finite`` and ``prefix`` of :class:`Filter`.

    Raises:
        ValueError: if the shapes do not fit, a number is not finite, Q, R or ``cov`` is no covariance, or one noise is
            given twice or not at all.

    Example:
        >>> from tensordict import TensorDict
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise=[0.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> td = kf.initialise(TensorDict({"observation": torch.ones(1)}))
        >>> kf.step(td)["belief", "mean"]
        tensor([0.5000])
    """

    def __init__(
        self,
        transition: torch.Tensor,
        observation: torch.Tensor,
        *,
        process_noise: Sequence[float] | torch.Tensor | None = None,
        process_noise_cov: torch.Tensor | None = None,
        noise: Sequence[float] | torch.Tensor | None = None,
        noise_cov: torch.Tensor | None = None,
        mean: torch.Tensor,
        cov: torch.Tensor,
        control: torch.Tensor | None = None,
        reading_space: Space | None = None,
        sensor_error: SensorError | None = None,
        observation_key: NestedKey = "observation",
        observed_key: NestedKey = "observed",
        **kwargs: Unpack[FilterOptions],
    ):
        given: dict[str, Any] = {"transition": transition, "observation": observation, "mean": mean, "cov": cov}
        noises: dict[str, Any] = {"process_noise": process_noise, "process_noise_cov": process_noise_cov}
        noises |= {"noise": noise, "noise_cov": noise_cov}
        given |= {name: value for name, value in noises.items() if value is not None}
        constants = {name: as_floating(value, name) for name, value in given.items()}
        check_one_dtype(**constants)
        f, h, m, p = (constants[name] for name in ("transition", "observation", "mean", "cov"))
        check_square("transition", f)
        size, readings = len(f), len(h) if h.ndim else 0
        check_shape("observation", h, (readings, size), "[O, S]")
        check_shape("mean", m, (size,), "[S]")
        check_values("transition", f)
        check_values("observation", h)
        q = _covariance("process_noise", constants, size, "[S]")
        r = _covariance("noise", constants, readings, "[O]")
        check_kind("sensor_error", sensor_error)
        if sensor_error is not None:
            f, h, q, m, p, control = sensor_error.augmented_matrices(f, h, q, m, p, control)
        action: dict[str, Any] = {}
        if control is not None:
            action = {"control": control, "action_key": kwargs.get("control_keys", ("action",))[0]}
        modules = OrderedDict(
            transition=LinearTransition(f, q.diag() if q.ndim == 1 else q, **action),
            analysis=KalmanAnalysis(
                h, r, observation_key=observation_key, observed_key=observed_key, reading_space=reading_space
            ),
        )
        super().__init__(modules, initial=MomentPrior(m, p), **kwargs)


def _covariance(name: str, given: dict[str, torch.Tensor], size: int, shape: str) -> torch.Tensor:
    """Returns the variances for standard deviations ``name``, or the covariance ``name_cov``."""
    if (name in given) == (f"{name}_cov" in given):
        raise ValueError(f"Give {name}, standard deviations {shape}, or {name}_cov, a matrix, and not both.")
    if name not in given:
        check_covariance(f"{name}_cov", given[f"{name}_cov"], size)
        return given[f"{name}_cov"]
    std = given[name]
    check_shape(name, std, (size,), shape)
    check_values(name, std, least=0, cure="These are standard deviations")
    return std.square()
