"""The iterated ensemble Kalman smoother as a filter: for steps that are strongly non-linear."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Unpack

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase

from torch_denkf.baselines.iterated_analysis import IteratedAnalysis, with_smoothed
from torch_denkf.filters import Filter
from torch_denkf.filters.options import FilterOptions
from torch_denkf.functional.manifolds import Space
from torch_denkf.modules import NoisyTransition, as_process_noise
from torch_denkf.running import check_module
from torch_denkf.submodel import Initial, role

__all__ = ["IEnKS"]


class IEnKS(Filter):
    """Iterated ensemble Kalman smoother: each reading corrects the state before the step, and the step is made anew.

    Where a step bends much (long steps of a chaotic system, say), the linear update of an ensemble filter is a poor map
    from readings to states. Here a few members suffice. Its belief of t is ``("belief", "ensemble")``, ``mean`` and
    ``var``; that of t - 1, given the reading of t, stands under ``("smoothed", ...)``. Each step runs the transition
    ``iterations + 2`` times.

    Args:
        transition: forecasts ``("forecast", "ensemble")``; deterministic.
        sensor: writes the reading; ``None`` where it is in the tensordict, under ``observation_key``.
        observation: writes ``("forecast", "observation")``; deterministic.
        noise: writes the reading's variances.
        initial: the initial belief, which also fixes the number of members.
        iterations: of Gauss-Newton.
        inflation: factor on the anomalies of the smoothed members, where anything is observed.
        rotate: random mean-preserving rotation of them.
        process_noise: Q of the motion: standard deviations ``[S]`` (a number for all), or a module that writes Q, see
            :mod:`torch_denkf.modules.process_noise`. ``None``: the motion is exact.
        reading_space: in which the reading lives; ``None`` for plain numbers. The initial belief has that of the state.
        observation_key: the reading; the sensor's by default.
        **kwargs: ``control_keys``, ``init_key``, ``forecast_keys``, ``variance_ceiling`` and ``check_finite`` of
            :class:`~torch_denkf.filters.Filter`.

    Raises:
        ValueError: if a model draws noise of its own, it is not clear where the reading is, or ``update_at_reset`` is
            asked for: the first frame has no step before it.

    Reference:
        Bocquet & Sakov, "An iterative ensemble Kalman smoother", Q. J. R. Meteorol. Soc. 140, 2014, with a lag of one
        step: Sakov, Oliver & Bertino, Monthly Weather Review 140, 2012. With process noise: Sakov, Haussaire & Bocquet,
        Q. J. R. Meteorol. Soc. 144, 2018.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, Select
        >>> smoother = IEnKS(
        ...     LearnedTransition(torch.sin),
        ...     None,
        ...     Select([0]),
        ...     ConstantNoise([0.1], in_key="reading"),
        ...     initial=GaussianPrior([0.0], [1.0], ensemble_size=5),
        ...     observation_key="reading",
        ... )
        >>> out = smoother.sequence(TensorDict({"reading": torch.ones(3, 1)}, [3]))
        >>> out["smoothed", "mean"].shape, out["smoothed", "age"].flatten()
        (torch.Size([3, 1]), tensor([0, 1, 1]))
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        sensor: TensorDictModuleBase | None,
        observation: TensorDictModuleBase,
        noise: TensorDictModuleBase,
        *,
        initial: TensorDictModuleBase,
        iterations: int = 10,
        inflation: float = 1.0,
        rotate: bool = False,
        process_noise: TensorDictModuleBase | Sequence[float] | float | None = None,
        reading_space: Space | None = None,
        observation_key: NestedKey | None = None,
        **kwargs: Unpack[FilterOptions],
    ):
        if kwargs.get("update_at_reset"):
            raise ValueError("IEnKS corrects the state before a step: the first frame has none, so no update_at_reset.")
        if observation_key is None and sensor is None:
            raise ValueError("Without a sensor, say where the reading is: observation_key=...")
        check_module("noise", noise)
        if sensor is not None:
            check_module("sensor", sensor)
        space = role(initial, Initial).space
        if process_noise is not None:
            transition = NoisyTransition(transition, as_process_noise(process_noise, initial), space=space)
        reading = sensor.out_keys[0] if sensor is not None and observation_key is None else observation_key
        analysis = IteratedAnalysis(
            transition,
            observation,
            iterations=iterations,
            inflation=inflation,
            rotate=rotate,
            space=space,
            reading_space=reading_space,
            observation_key=reading,
            noise_variance_key=noise.out_keys[0],
        )
        modules = OrderedDict(sensor=sensor) if sensor is not None else OrderedDict()
        modules.update(noise=noise, transition=transition, analysis=analysis)
        super().__init__(modules, initial=with_smoothed(initial), **kwargs)
