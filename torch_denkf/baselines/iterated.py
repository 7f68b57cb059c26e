"""The iterated ensemble Kalman smoother as a filter, for strongly non-linear dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from tensordict.nn import TensorDictModuleBase

from torch_denkf.baselines.iterated_analysis import IteratedAnalysis, with_smoothed
from torch_denkf.filters import Filter
from torch_denkf.filters.parts import FilterParts, ReadingOptions

__all__ = ["IEnKS"]


class IEnKS(Filter):
    """Iterated ensemble Kalman smoother: each reading corrects the previous state, and the transition runs again.

    Under strongly non-linear dynamics (long steps of a chaotic system, say), the linear update of an ensemble filter
    is a poor map from readings to states. This smoother needs few members there. The belief of t is ``("belief",
    "ensemble")``, ``mean`` and ``var``; the smoothed belief of t - 1, given the reading of t, is ``("smoothed",
    ...)``. Each step runs the transition ``iterations + 2`` times.

    Args:
        transition: forecasts ``("forecast", "ensemble")``; deterministic.
        sensor: writes the reading; ``None`` if the tensordict has it under ``observation_key``.
        observation: writes ``("forecast", "observation")``; deterministic.
        noise: writes the reading's variances.
        initial: the initial belief, which also fixes the number of members.
        iterations: number of Gauss-Newton iterations.
        inflation: factor on the anomalies of the smoothed members, in elements with an observation.
        rotate: applies a random mean-preserving rotation to the anomalies.
        process_noise: Q of the motion: standard deviations ``[S]`` (a number for all), or a module that writes Q, see
            :mod:`torch_denkf.modules.process_noise`. ``None``: the motion is exact.
        **options: ``reading_space``, ``observation_key``, ``observed_key``, ``sensor_error`` and the options of every
            filter, see :class:`~torch_denkf.filters.parts.ReadingOptions`; no ``update_at_reset``, no ``visibility``.

    Raises:
        ValueError: if transition or observation draws noise, the reading's key is ambiguous, or ``update_at_reset`` is
            set: the first frame has no step before it.

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
        **options: Unpack[ReadingOptions],
    ):
        if options.get("update_at_reset"):
            raise ValueError("IEnKS corrects the state before a step: the first frame has none, so no update_at_reset.")
        parts = FilterParts(transition, sensor, observation, noise, initial, process_noise, **options)
        transition = parts.moving()
        analysis = IteratedAnalysis(
            transition,
            parts.observation,
            iterations=iterations,
            inflation=inflation,
            rotate=rotate,
            space=parts.space,
            **parts.reading(),
        )
        modules = parts.in_order(transition=transition, analysis=analysis)
        super().__init__(modules, initial=with_smoothed(parts.initial), **parts.options)
