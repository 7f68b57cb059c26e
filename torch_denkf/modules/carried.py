"""An initial belief beside which the state of another module begins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase

from torch_denkf.modules._running import reads, run_module
from torch_denkf.modules.past import InPlaceOf, copy_sizes

__all__ = ["Stateful", "WithState"]


class Stateful(Protocol):
    """A module that carries entries of its own from step to step.

    Attributes:
        state_keys: their keys.
    """

    state_keys: Sequence[NestedKey]

    def initial_state(self, batch_size, *, device=None, dtype=None) -> list[torch.Tensor]:
        """Their values at the start of an episode, in the order of the keys."""


class WithState(InPlaceOf):
    """An initial belief, and the entries that other modules carry on.

    Args:
        initial: the initial belief.
        owners: such as :class:`InnovationMonitor` and :class:`GatedAnalysis`.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior, InnovationMonitor, MonitoredSensor
        >>> monitor = InnovationMonitor({"gps": MonitoredSensor("info", 2)})
        >>> start = WithState(GaussianPrior([0.0], [1.0], ensemble_size=4), [monitor])
        >>> start(TensorDict({}, [3]))["monitor", "gps", "p_value"].flatten()
        tensor([1., 1., 1.])
    """

    def __init__(self, initial: TensorDictModuleBase, owners: Sequence[Stateful]):
        needed, optional = reads(initial)
        keys = [key for owner in owners for key in owner.state_keys]
        super().__init__(initial, needed, [*initial.out_keys, *keys], optional_keys=optional)
        self._owners = tuple(owners)  # in a tuple they are not modules of this one: the filter has them already
        copy_sizes(initial, self)

    def on_entries(self, entries, call):
        """The belief and the entries."""
        written = run_module(self.module, entries, call)
        like = next(value for value in written.values() if value.is_floating_point())
        for owner in self._owners:
            state = owner.initial_state(call.batch_size, device=like.device, dtype=like.dtype)
            written = {**written, **dict(zip(owner.state_keys, state, strict=True))}
        return written
