r"""A filter that also carries its last L states, which each new reading corrects: the parts of fixed-lag smoothing.

:class:`torch_denkf.smoothers.FixedLag` puts them into a filter. The order of a step is

    transition -- past (moves on by one) -- observation, analysis (of present and past) -- lagged belief

The past of the first steps of an episode is the episode's first state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn

from torch_denkf._checks import check_count, check_shape
from torch_denkf.functional import ensemble_mean, ensemble_var, weighted_mean, weighted_var
from torch_denkf.modules._base import SubModel
from torch_denkf.modules._running import check_module, named_modules_of, reads, run_module
from torch_denkf.modules.analysis import EnsembleAnalysis
from torch_denkf.modules.local_analysis import LocalEnsembleAnalysis

__all__ = ["EnsemblePast", "LaggedAnalysis", "LaggedBelief", "WithEnsemblePast", "WithPast"]


class InPlaceOf(SubModel):
    """A sub-model around another, whose place it takes: the noise of the inner one keeps its name."""

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Those of the module inside."""
        return getattr(self.module, "noise_names", ())

    def draw_noise(self, batch_size, **sizes):
        """Draws the noise of the module inside."""
        return self.module.draw_noise(batch_size, **sizes)

    def of_carry(self, entries):
        """What follows for the module inside."""
        return self.module.of_carry(entries) if isinstance(self.module, SubModel) else {}

    def parts(self):
        """Those of the module inside."""
        if type(self.module) is TensorDictSequential:
            return dict(named_modules_of(self.module))
        return self.module.parts() if isinstance(self.module, SubModel) else {}


class WithPast(InPlaceOf):
    """An initial belief, its past and what is smoothed of it; a subclass says which entries these are.

    Args:
        initial: writes the belief.
        lag: L.
        age: steps between the first belief of an episode and the first state: 0, or -1 where that belief is yet to be
            updated with its own frame.
        belief_key: prefix of the belief and of its past.
        smoothed_key: prefix of what is smoothed.

    Raises:
        ValueError: if ``lag`` is not positive.
    """

    #: Last names of the past's entries, and of the smoothed ones.
    PAST: ClassVar[tuple[str, ...]] = ()
    SMOOTHED: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        initial: TensorDictModuleBase,
        lag: int,
        *,
        age: int = 0,
        belief_key: str = "belief",
        smoothed_key: str = "smoothed",
    ):
        check_positive_lag(lag)
        check_module("initial", initial)
        needed, optional = reads(initial)
        own = [*((belief_key, name) for name in self.PAST), *((smoothed_key, name) for name in self.SMOOTHED)]
        super().__init__(initial, needed, [*initial.out_keys, *own], optional_keys=optional)
        self.lag, self.age, self.belief_key, self._own = lag, age, belief_key, list(map(unravel_key, own))
        copy_sizes(initial, self)


class WithEnsemblePast(WithPast):
    """An initial belief with a past: L copies of its members.

    Args:
        initial: writes an ensemble ``[*B, E, S]``, for particles with log-weights ``[*B, E]``.
        lag: L.
        age: steps between the first belief of an episode and the first state: 0, or -1 where that belief is yet to be
            updated with its own frame.
        belief_key: prefix of ``ensemble``, of ``log_weight`` and of the ``past`` ``[*B, E, L, S]``, the latest first.
        smoothed_key: prefix of ``ensemble``, ``mean``, ``var`` and ``age``, see :class:`LaggedBelief`.

    Raises:
        ValueError: if ``lag`` is not positive.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior
        >>> start = WithEnsemblePast(GaussianPrior([0.0], [1.0], ensemble_size=4), lag=3)
        >>> start(TensorDict({}))["belief", "past"].shape
        torch.Size([4, 3, 1])
    """

    PAST = ("past",)
    SMOOTHED = ("ensemble", "mean", "var", "age")

    def on_entries(self, entries, call):
        """The belief and its past."""
        written = run_module(self.module, entries, call)
        ensemble = written[self.belief_key, "ensemble"]
        log_weight = written.get((self.belief_key, "log_weight"))
        past = ensemble.unsqueeze(-2).repeat_interleave(self.lag, -2)
        age = torch.full((*call.batch_size, 1), self.age, device=ensemble.device)
        own = (past, ensemble, *moments_of(ensemble, log_weight), age)
        return {**written, **dict(zip(self._own, own, strict=True))}

    def of_carry(self, entries):
        """The oldest state."""
        ensemble = entries[self.belief_key, "past"][..., -1, :]
        moments = moments_of(ensemble, entries.get((self.belief_key, "log_weight")))
        return {**super().of_carry(entries), **dict(zip(self._own[1:], (ensemble, *moments), strict=False))}


class EnsemblePast(SubModel):
    """The past moves on by one step: the last belief becomes its latest state, the oldest is forgotten.

    Args:
        belief_key: prefix of ``ensemble`` ``[*B, E, S]`` and ``past`` ``[*B, E, L, S]``, the latest first.
        out_key: the past of the new time, ``[*B, E, L, S]``.

    Example:
        >>> from tensordict import TensorDict
        >>> belief = {"ensemble": torch.tensor([[3.0]]), "past": torch.tensor([[[2.0], [1.0]]])}
        >>> EnsemblePast()(TensorDict({"belief": belief}))["forecast", "past"].flatten()
        tensor([3., 2.])
    """

    def __init__(self, *, belief_key: str = "belief", out_key: NestedKey = ("forecast", "past")):
        super().__init__(nn.Identity(), [(belief_key, "ensemble"), (belief_key, "past")], [out_key])

    def compute(self, ensemble, past):
        """The past."""
        return torch.cat([ensemble.unsqueeze(-2), past[..., :-1, :]], -2)


class LaggedAnalysis(InPlaceOf):
    """An analysis that corrects the past with the same reading, by the past's covariance with the prediction.

    It is the ensemble Kalman smoother (Evensen & van Leeuwen 2000). The past is neither inflated nor relaxed.

    Args:
        analysis: :class:`EnsembleAnalysis` or :class:`LocalEnsembleAnalysis`; its keys and its noise are kept.
        past_key: the past ``[*B, E, L, S]``, read and written.

    Raises:
        TypeError: for another analysis, which does not say what it does to other states.

    Example:
        >>> from tensordict import TensorDict
        >>> members = torch.tensor([[-1.0], [1.0]])
        >>> td = TensorDict({
        ...     "forecast": {"ensemble": members, "observation": members, "past": members.unsqueeze(-1) / 2},
        ...     "sensor": {"ensemble": torch.tensor([4.0]), "noise": torch.tensor([2.0])},
        ... })
        >>> td = LaggedAnalysis(EnsembleAnalysis("etkf"))(td)
        >>> td["belief", "mean"].round(decimals=4), td["forecast", "past"].mean().round(decimals=4)
        (tensor([2.]), tensor(1.))
    """

    def __init__(
        self,
        analysis: EnsembleAnalysis | LocalEnsembleAnalysis,
        *,
        past_key: NestedKey = ("forecast", "past"),
    ):
        if not isinstance(analysis, EnsembleAnalysis | LocalEnsembleAnalysis):
            raise TypeError(
                f"{type(analysis).__name__} does not say what a reading means for earlier states. A lag needs an "
                "EnsembleAnalysis or a LocalEnsembleAnalysis; smooth other ensembles with EnRTS."
            )
        super().__init__(
            analysis,
            [*analysis.in_keys, past_key],
            [*analysis.out_keys, past_key],
            optional_keys=analysis.optional_keys,
        )
        self.info_key, self.reading_keys = analysis.info_key, analysis.reading_keys
        self.observed_key, self.reads_components = analysis.observed_key, analysis.reads_components
        if hasattr(analysis, "noise_variance_key"):
            self.noise_variance_key = analysis.noise_variance_key

    def noise_sizes(self, *values):
        """Those of the analysis."""
        return self.module.noise_sizes(*values)

    def without_reading(self, *values):
        """The belief where there is no reading: the forecast, and the past as it is."""
        past = values[len(self.module.in_keys)]
        return *self.module.without_reading(*values), past

    def compute(self, forecast, predicted, observation, variance, past, observed=None, *, noise):
        """The belief, the diagnostics, and the past."""
        out = self.module.compute(forecast, predicted, observation, variance, observed, noise=noise)
        return *out, self.module.move_past(past, predicted, observation, variance, observed, noise=noise)


class LaggedBelief(SubModel):
    """What is believed of the state L steps ago, given all readings up to now.

    Args:
        belief_key: prefix of the ``past`` ``[*B, E, L, S]`` that is carried on, and of ``log_weight`` ``[*B, E]``.
        smoothed_key: prefix of ``ensemble`` ``[*B, E, S]``, ``mean`` and ``var`` ``[*B, S]``, and ``age`` ``[*B, 1]``:
            by how many steps the state lies back, L, or fewer where the episode is younger.
        past_key: the past after the analysis, ``[*B, E, L, S]``.
        weighted: whether the members are particles with log-weights.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"forecast": {"past": torch.tensor([[[3.0], [1.0]], [[5.0], [2.0]]])}})
        >>> td["smoothed", "age"] = torch.tensor([7])
        >>> LaggedBelief()(td)["smoothed", "mean"], td["smoothed", "age"]
        (tensor([1.5000]), tensor([2]))
    """

    def __init__(
        self,
        *,
        belief_key: str = "belief",
        smoothed_key: str = "smoothed",
        past_key: NestedKey = ("forecast", "past"),
        weighted: bool = False,
    ):
        age = (smoothed_key, "age")
        out_keys = [(belief_key, "past"), *((smoothed_key, name) for name in ("ensemble", "mean", "var")), age]
        super().__init__(nn.Identity(), [past_key, age] + [(belief_key, "log_weight")] * weighted, out_keys)

    def compute(self, past, age, log_weight=None):
        """The past, and the belief of its oldest state."""
        check_age(age, past.shape[:-3])
        ensemble = past[..., -1, :]
        return past, ensemble, *moments_of(ensemble, log_weight), (age + 1).clamp(max=past.shape[-2])


def check_age(age: torch.Tensor, batch_size: Sequence[int]) -> None:
    """Raise unless the age of the oldest state that is carried is ``[*B, 1]``."""
    check_shape("the age of what is smoothed", age, (*batch_size, 1), "[*B, 1]")


def moments_of(ensemble: torch.Tensor, log_weight: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and variance ``[*B, S]`` of members, or of weighted particles."""
    if log_weight is not None:
        return weighted_mean(ensemble, log_weight), weighted_var(ensemble, log_weight)
    mean = ensemble_mean(ensemble)
    return mean, ensemble_var(ensemble, mean)


def check_positive_lag(lag: int) -> None:
    """Raise unless there is something to look back at."""
    check_count("lag", lag, cure="It counts the steps to look back")


def copy_sizes(initial: nn.Module, owner: nn.Module) -> None:
    """What an initial belief says about its sizes."""
    for name in ("ensemble_size", "state_dim", "observation_dim", "input_dim"):
        if hasattr(initial, name):
            setattr(owner, name, getattr(initial, name))
