"""The differentiable unscented Kalman filter, with the sub-models of an ensemble filter on sigma points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

from tensordict.nn import TensorDictModuleBase

from torch_denkf.filters.base import Filter
from torch_denkf.filters.parts import FilterParts, ReadingOptions, check_moments
from torch_denkf.modules.ukf import UKFAnalysis, UKFTransition

__all__ = ["UKF"]


class UKF(Filter):
    """Unscented Kalman filter whose transition, sensor, observation and noise models may all be learned (dUKF).

    It takes the modules of :class:`~torch_denkf.filters.DEnKF` and a process noise, and has the belief of
    :class:`~torch_denkf.filters.EKF`. 2 S + 1 sigma points pass through the transition as an ensemble, and new ones
    through the observation model.

    Args:
        transition: forecasts ensembles ``[*B, E, S]``; its stochastic networks run their deterministic forward.
        sensor: writes ``("sensor", "ensemble")`` ``[*B, E, O]``, whose mean is the reading; ``None`` if the
            reading is in the tensordict, under ``observation_key``.
        observation: observes ensembles, writes ``("forecast", "observation")``.
        noise: R, writes ``("sensor", "noise")``: variances ``[*B, O]`` or a covariance ``[*B, O, O]``.
        process_noise: Q: standard deviations ``[S]`` (one number for all, 0 for none), or a module that writes it, see
            :mod:`torch_denkf.modules.process_noise`.
        initial: the initial belief, :class:`~torch_denkf.modules.MomentPrior` or
            :class:`~torch_denkf.modules.GaussianAround`; its covariance may be singular.
        alpha: spread of the sigma points.
        beta: extra weight of the central point in the covariance.
        kappa: second scaling parameter of the spread. Covariances stay positive if no weight is negative, the default.
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
        >>> q = ConstantNoise([0.1], in_key=("belief", "mean"), out_key=("forecast", "noise"))
        >>> r = ConstantNoise([0.1], in_key="reading")
        >>> ukf = UKF(
        ...     LearnedTransition(torch.sin, residual=False), None, Select([0]), r, process_noise=q,
        ...     initial=GaussianAround([0.0]), observation_key="reading",
        ... )
        >>> ukf.sequence(TensorDict({"reading": torch.zeros(3, 1), "state": torch.zeros(3, 1)}, [3]))["belief", "var"]
        tensor([[0.0000],
                [0.0050],
                [0.0060]])
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
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float = 0.5,
        inflation: float = 1.0,
        **options: Unpack[ReadingOptions],
    ):
        parts = FilterParts(transition, sensor, observation, noise, initial, process_noise, **options)
        check_moments(type(self).__name__, initial)
        both: dict[str, Any] = {"alpha": alpha, "beta": beta, "kappa": kappa, "space": parts.space}
        forecast = UKFTransition(parts.transition, parts.process_noise, **both)
        update = UKFAnalysis(parts.observation, inflation=inflation, **both, **parts.reading())
        modules = parts.in_order(transition=forecast, analysis=update)
        super().__init__(modules, initial=parts.initial, **parts.options)
