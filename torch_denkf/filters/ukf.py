"""The differentiable unscented Kalman filter: the same sub-models as an ensemble filter's, on sigma points."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Unpack

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase

from torch_denkf.filters.base import Filter, FilterOptions
from torch_denkf.modules.process_noise import as_process_noise
from torch_denkf.modules.ukf import UKFAnalysis, UKFTransition

__all__ = ["UKF"]


class UKF(Filter):
    """Unscented Kalman filter whose transition, sensor, observation and noise models may all be learned (dUKF).

    It takes the modules of :class:`~torch_denkf.filters.DEnKF` and a process noise, and has the belief of
    :class:`~torch_denkf.filters.EKF`. 2 S + 1 sigma points go through the transition as an ensemble, and fresh ones
    through the observation model.

    Args:
        transition: forecasts ensembles ``[*B, E, S]``; its stochastic networks run their deterministic forward.
        process_noise: Q: standard deviations ``[S]`` (a number for all, 0 for none), or a module that writes it, see
            :mod:`torch_denkf.modules.process_noise`.
        sensor: writes ``("sensor", "ensemble")`` ``[*B, E, O]``, whose mean is the reading; ``None`` where the
            reading is in the tensordict, under ``observation_key``.
        observation: observes ensembles, writes ``("forecast", "observation")``.
        noise: R, writes ``("sensor", "noise")``: variances ``[*B, O]`` or a covariance ``[*B, O, O]``.
        initial: the initial belief, see :class:`~torch_denkf.filters.EKF`; its covariance may be singular.
        alpha: see :func:`torch_denkf.functional.unscented_weights`.
        beta: likewise.
        kappa: likewise. Covariances stay positive where no weight is negative, as by default.
        inflation: factor on the belief's standard deviations, where anything is observed. What is never observed grows
            by it without bound.
        angles: components of the observation that are angles in radians.
        observation_key: the reading, ``[*B, O]`` or ``[*B, E, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``; the observation model may write it.
        **kwargs: ``control_keys``, ``init_key``, ``update_at_reset``, ``forecast_keys``, ``variance_ceiling`` and
            ``check_finite`` of :class:`Filter`.

    Reference:
        Kloss, Martius, Bohg, "How to train your differentiable filter", 2021, arXiv:2012.14313, section 3.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise, GaussianAround, LearnedTransition, Select
        >>> q = ConstantNoise([0.1], in_key=("belief", "mean"), out_key=("forecast", "noise"))
        >>> r = ConstantNoise([0.1], in_key="reading")
        >>> ukf = UKF(
        ...     LearnedTransition(torch.sin, residual=False), q, None, Select([0]), r,
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
        process_noise: TensorDictModuleBase | Sequence[float] | float,
        sensor: TensorDictModuleBase | None,
        observation: TensorDictModuleBase,
        noise: TensorDictModuleBase,
        *,
        initial: TensorDictModuleBase,
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float = 0.5,
        inflation: float = 1.0,
        angles: Sequence[int] = (),
        observation_key: NestedKey = ("sensor", "ensemble"),
        observed_key: NestedKey = "observed",
        **kwargs: Unpack[FilterOptions],
    ):
        modules = OrderedDict(sensor=sensor) if sensor is not None else OrderedDict()
        modules.update(
            noise=noise,
            transition=UKFTransition(
                transition, as_process_noise(process_noise, initial), alpha=alpha, beta=beta, kappa=kappa
            ),
            analysis=UKFAnalysis(
                observation,
                alpha=alpha,
                beta=beta,
                kappa=kappa,
                inflation=inflation,
                angles=angles,
                observation_key=observation_key,
                noise_variance_key=noise.out_keys[0],
                observed_key=observed_key,
            ),
        )
        super().__init__(modules, initial=initial, **kwargs)
