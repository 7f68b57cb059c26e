"""The differentiable extended Kalman filter, with the sub-models of an ensemble filter and their Jacobians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from tensordict.nn import TensorDictModuleBase

from torch_denkf.filters.base import Filter
from torch_denkf.filters.parts import FilterParts, ReadingOptions, check_moments
from torch_denkf.modules.ekf import EKFAnalysis, EKFTransition

__all__ = ["EKF"]


class EKF(Filter):
    """Extended Kalman filter whose transition, sensor, observation and noise models may all be learned (dEKF).

    It takes the modules of :class:`~torch_denkf.filters.DEnKF` and a process noise: its covariance Q takes the role of
    an ensemble filter's stochastic transition. Its belief is ``("belief", "mean")`` ``[*B, S]``, ``("belief", "cov")``
    ``[*B, S, S]`` and ``("belief", "var")`` ``[*B, S]``. If nothing is observed the covariance still grows to
    F P F^T + Q.

    Args:
        transition: forecasts ensembles ``[*B, E, S]``; its stochastic networks run their deterministic forward.
        sensor: writes ``("sensor", "ensemble")`` ``[*B, E, O]``, whose mean is the reading; ``None`` if the
            reading is in the tensordict, under ``observation_key``.
        observation: observes ensembles, writes ``("forecast", "observation")``.
        noise: R, writes ``("sensor", "noise")``: variances ``[*B, O]`` or a covariance ``[*B, O, O]``.
        process_noise: Q: standard deviations ``[S]`` (one number for all, 0 for none), or a module that writes it, see
            :mod:`torch_denkf.modules.process_noise`.
        initial: the initial belief: :class:`~torch_denkf.modules.MomentPrior`,
            :class:`~torch_denkf.modules.GaussianAround`.
        stop_jacobian_gradient: whether the transition's Jacobian is a constant to the gradient.
        inflation: factor of the belief's standard deviations where anything is observed. Components that are never
            observed grow by it without bound.
        **options: ``reading_space``, ``observation_key``, ``observed_key``, ``visibility``, ``sensor_error`` and the
            common options of filters, see :class:`~torch_denkf.filters.parts.ReadingOptions`.

    Raises:
        ValueError: if the source of the reading is ambiguous, or ``initial`` writes no mean and covariance.

    Reference:
        Kloss, Martius, Bohg, "How to train your differentiable filter", 2021, arXiv:2012.14313, section 3.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise, GaussianAround, LearnedTransition, Select
        >>> move = torch.tensor([[1.0, 0.1], [0.0, 1.0]])  # [position m, speed m/s], 0.1 s later
        >>> ekf = EKF(
        ...     LearnedTransition(lambda state: state @ move.T, residual=False),
        ...     None,
        ...     Select([1]),
        ...     ConstantNoise([0.3], in_key="reading"),
        ...     process_noise=[0.0, 0.5],
        ...     initial=GaussianAround([0.0, 1.0]),
        ...     observation_key="reading",
        ... )
        >>> drive = TensorDict({"reading": torch.full((9, 1), 10.0), "state": torch.zeros(9, 2)}, [9])
        >>> ekf.sequence(drive)["belief", "mean"][-1, 0] > 6.0  # m in 8 steps, from a wrong speed
        tensor(True)
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        sensor: TensorDictModuleBase | None,
        observation: TensorDictModuleBase,
        noise: TensorDictModuleBase,
        *,
        process_noise: TensorDictModuleBase | Sequence[float] | float,
        initial: TensorDictModuleBase,
        stop_jacobian_gradient: bool = False,
        inflation: float = 1.0,
        **options: Unpack[ReadingOptions],
    ):
        parts = FilterParts(transition, sensor, observation, noise, initial, process_noise, **options)
        check_moments(type(self).__name__, initial)
        forecast = EKFTransition(
            parts.transition, parts.process_noise, stop_jacobian_gradient=stop_jacobian_gradient, space=parts.space
        )
        update = EKFAnalysis(parts.observation, inflation=inflation, space=parts.space, **parts.reading())
        modules = parts.in_order(transition=forecast, analysis=update)
        super().__init__(modules, initial=parts.initial, **parts.options)
