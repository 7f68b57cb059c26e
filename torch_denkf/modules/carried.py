"""Modules around another one: in its place, around an analysis, and an initial belief with further entries."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Protocol

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf.modules._gaussian import GaussianAnalysis
from torch_denkf.running import (
    check_module,
    declared,
    is_sequence,
    named_modules_of,
    reads,
    run_module,
    writes,
)
from torch_denkf.submodel import Call, Entries, SubModel

__all__ = ["AnalysisAround", "Beside", "InPlaceOf", "Stateful", "with_state"]


class InPlaceOf(SubModel):
    """A sub-model around another, whose place it takes: the noise of the inner one keeps its name."""

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Those of the module inside."""
        return declared(self.module).noise_names

    def draw_noise(self, batch_size, **sizes):
        """Draws the noise of the module inside."""
        return self.module.draw_noise(batch_size, **sizes)

    def of_carry(self, entries):
        """What follows for the module inside."""
        return self.module.of_carry(entries) if isinstance(self.module, SubModel) else {}

    def parts(self):
        """Those of the module inside."""
        if is_sequence(self.module):
            return dict(named_modules_of(self.module))
        return self.module.parts() if isinstance(self.module, SubModel) else {}


class AnalysisAround(InPlaceOf):
    """An analysis around another, which can be put around a third one: a gate, for example."""

    def around(self, analysis: SubModel) -> AnalysisAround:
        """The same with another analysis inside."""
        raise TypeError(f"{type(self).__name__} has no around(): write it, so that it can be lagged and delayed.")

    def with_mask(self, entries: Entries, call: Call) -> Entries:
        """The entries with the mask, where an observation model inside the analysis makes it."""
        if not isinstance(self.module, GaussianAnalysis) or self.observed_key not in writes(self.module.module):
            return entries
        mean = self.required(entries, self.in_keys[0])
        mask = self.module.mask(entries, mean, call)
        return entries if mask is None else {**entries, self.observed_key: mask}


class Stateful(Protocol):
    """A module that carries entries of its own from step to step.

    Attributes:
        state_keys: their keys.
    """

    state_keys: Sequence[NestedKey]

    def initial_state(self, batch_size, *, device=None, dtype=None) -> list[torch.Tensor]:
        """Their values at the start of an episode, in the order of the keys."""


class Beside(InPlaceOf):
    """An initial belief, and further entries that begin with the episode.

    Args:
        initial: the initial belief.
        keys: the further entries.
        begin: their values, in that order, from the belief (its tensors by key) and its batch size. So that the filter
            can be pickled, it is a function of a module, its options in a :class:`functools.partial`.
        follow_keys: entries of the belief that follow from those that are carried on.
        follow: their values, in that order, from the entries that are carried on, or from those that ``begin`` gives.
        nested: whether the noise of ``initial`` has its place inside of this one's: ``("noise", "initial.initial")``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior
        >>> def no_steps(belief, batch_size):
        ...     return [torch.zeros(*batch_size, 1)]
        >>> start = Beside(GaussianPrior([0.0], [1.0], ensemble_size=4), ["steps"], no_steps)
        >>> start(TensorDict({}, [3]))["steps"].flatten()
        tensor([0., 0., 0.])
    """

    def __init__(
        self,
        initial: TensorDictModuleBase,
        keys: Sequence[NestedKey],
        begin: Callable[[Entries, torch.Size], Iterable[torch.Tensor]],
        *,
        follow_keys: Sequence[NestedKey] = (),
        follow: Callable[[Entries], Iterable[torch.Tensor]] | None = None,
        nested: bool = False,
    ):
        check_module("initial", initial)
        needed, optional = reads(initial)
        out_keys = dict.fromkeys(map(unravel_key, (*initial.out_keys, *keys, *follow_keys)))
        super().__init__(initial, needed, list(out_keys), optional_keys=optional)
        self.keys, self.begin = list(map(unravel_key, keys)), begin
        self.follow_keys, self.follow, self.nested = list(map(unravel_key, follow_keys)), follow, nested
        for name in ("ensemble_size", "state_dim", "observation_dim", "input_dim", "space"):
            setattr(self, name, getattr(declared(initial), name))

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Those of the module inside, unless it is a part."""
        return () if self.nested else super().noise_names

    def parts(self):
        """Those of the module inside, or this one."""
        return {"initial": self.module} if self.nested else super().parts()

    def on_entries(self, entries, call):
        """The belief and the further entries."""
        written = dict(run_module(self.module, entries, call.part("initial") if self.nested else call))
        written.update(zip(self.keys, self.begin(written, call.batch_size), strict=True))
        return {**written, **self._following(written)}

    def of_carry(self, entries):
        """What follows for the module inside, and here."""
        return {**super().of_carry(entries), **self._following(entries)}

    def _following(self, entries: Entries) -> Entries:
        return {} if self.follow is None else dict(zip(self.follow_keys, self.follow(entries), strict=True))


def with_state(initial: TensorDictModuleBase, owners: Sequence[Stateful]) -> Beside:
    """An initial belief, and the entries that other modules carry on.

    Args:
        initial: the initial belief.
        owners: such as :class:`InnovationMonitor` and :class:`GatedAnalysis`.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior
        >>> from torch_denkf.monitoring import InnovationMonitor, MonitoredSensor
        >>> monitor = InnovationMonitor({"gps": MonitoredSensor("info", 2)})
        >>> start = with_state(GaussianPrior([0.0], [1.0], ensemble_size=4), [monitor])
        >>> start(TensorDict({}, [3]))["monitor", "gps", "p_value"].flatten()
        tensor([1., 1., 1.])
    """
    # In a tuple the owners are not modules of the belief: the filter has them already.
    return Beside(initial, [key for owner in owners for key in owner.state_keys], partial(_states, tuple(owners)))


def _states(owners: Sequence[Stateful], belief: Entries, batch_size: torch.Size) -> list[torch.Tensor]:
    like = next(value for value in belief.values() if value.is_floating_point())
    states = (owner.initial_state(batch_size, device=like.device, dtype=like.dtype) for owner in owners)
    return [value for state in states for value in state]
