"""Finishes a step before its outputs are written: checks that the belief is finite, and clones shared memory."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_denkf._checks import flag_value
from torch_denkf._registered import diagnosis
from torch_denkf.beliefs import Belief
from torch_denkf.filters.structure import Structure
from torch_denkf.functional.kernels.small_system import on_gpu
from torch_denkf.submodel import Entries

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

__all__ = ["RUNS", "Record", "check_belief", "own"]


#: The ways to run a filter.
RUNS = ("step", "sequence", "policy", "environment")


class Record(NamedTuple):
    """One run of a filter, passed to its observers before anything is written.

    Attributes:
        way: ``"step"``, ``"sequence"``, ``"policy"`` or ``"environment"``; ``"data"`` for a batch that a loss or a
            replay buffer is about to filter, for which nothing is written.
        tensordict: the tensordict passed to the filter.
        batch_size: batch size of the entries; differs from the tensordict's for concatenated slices.
        entries: inputs of the modules.
        written: outputs of the modules; for a sequence ``[*B, T, ...]``.
        env: the environment, if there is one.
    """

    way: Literal["step", "sequence", "policy", "environment", "data"]
    tensordict: TensorDictBase
    batch_size: torch.Size
    entries: Entries
    written: Entries
    env: EnvBase | None = None


def own(written: Entries, given: Iterable[Tensor] = ()) -> Entries:
    """Clones entries that are views or share the caller's memory, so that the filter's outputs own their memory."""
    if torch.compiler.is_compiling():  # a graph returns its own memory
        return written
    seen, out = set(map(id, given)), {}
    for key, value in written.items():
        out[key] = value.clone() if value._is_view() or id(value) in seen else value
        seen.add(id(value))
    return out


def check_belief(structure: Structure, entries: Entries, written: Entries) -> None:
    """Raises if the new belief, or the belief before the step, is not finite.

    Args:
        structure: structure of the filter.
        entries: inputs of the step.
        written: outputs of the step.

    Raises:
        ValueError: names the cause.
    """
    if on_gpu(written[structure.carry[0]]):  # reading values would wait for the device
        return
    numbers = [
        (value.sum() if kind is None else kind.finite(key[-1], value).log(), key, kind, value)
        for key, kind in structure.carried
        for value in (written[key], entries.get(key))  # resampling may have removed a particle that is not finite
        if value is not None and value.is_floating_point()
    ]
    total = sum([number for number, *_ in numbers[1:]], numbers[0][0]) if numbers else torch.zeros(())
    if flag_value(total - total == 0) is not False:  # fewer calls than isfinite() takes
        return
    if all((kind or Belief()).finite(key[-1], value) for _, key, kind, value in numbers):  # only their sum overflowed
        return
    raise ValueError(diagnosis().why_not_finite(structure, entries, written))
