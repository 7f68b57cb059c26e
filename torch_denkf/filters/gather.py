"""Gathers the inputs of steps: entries of a tensordict, and the initial or stored belief of each element."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf._registered import diagnosis
from torch_denkf._slices import one_earlier
from torch_denkf.filters.structure import FROM_STORED, HAS_PREVIOUS, Structure, previous_key
from torch_denkf.submodel import Call, Entries

__all__ = ["StepInputs", "controls_of", "gather_rows", "of_one_robot"]


class StepInputs(NamedTuple):
    """Inputs of the steps of a sequence.

    Attributes:
        size: ``[*B, T]``.
        inputs: entries ``[*B, T, ...]``.
        begins: elements that are reset to ``starts``, ``[*B, T, 1]``; ``[*B, 1, 1]`` if only the first may be.
        starts: initial or stored beliefs, ``[*B, T]`` or ``[*B, 1]``.
        stored: whether these beliefs are stored ones, which have seen their frame.
        before: the belief before the first element.
    """

    size: torch.Size
    inputs: Entries
    begins: Tensor
    starts: Entries
    stored: bool
    before: Entries

    @property
    def fresh(self) -> Tensor:
        """Masks elements that are reset, ``[*B, T, 1]``."""
        if self.begins.shape[-2] == self.size[-1]:
            return self.begins
        return _or_first(None, self.size, self.begins.device)


def of_one_robot(name: str, like: Tensor | None, tensordict: TensorDictBase | Mapping[str, Any]) -> TensorDictBase:
    """Returns a tensordict unchanged; a dictionary as a new one, ``[]``, with the dtype and device of ``like``."""
    if isinstance(tensordict, TensorDictBase):
        return tensordict
    if not isinstance(tensordict, Mapping):
        raise TypeError(
            f"{name} takes a tensordict, or a dictionary of numbers, arrays or tensors; got {type(tensordict).__name__}"
        )
    out = TensorDict(dict(tensordict), batch_size=[])
    out = out.apply(lambda value: value.reshape(1) if value.ndim == 0 else value)  # a number becomes an entry [1]
    if like is None:
        return out
    return out.apply(lambda value: value.to(like.device, like.dtype if value.is_floating_point() else None))


def gather_rows(
    structure: Structure,
    entries: Entries,
    marks: Tensor | None,
    size: torch.Size,
    start_of: Callable[[Entries, Call], Entries],
) -> StepInputs:
    """Collects the initial belief of each element of a sequence, and the inputs of its step.

    Args:
        structure: structure of the filter.
        entries: entries of the sequence, with the outputs of the frames' modules.
        marks: first elements, see :func:`torch_denkf._slices.starts_of`.
        size: ``[*B, T]``.
        start_of: returns the initial beliefs, from entries.
    """
    time, call, carry = len(size) - 1, Call(size, time=True), structure.carry
    resumed = all(previous_key(key) in entries for key in carry)
    stored = not resumed and all(key in entries for key in carry)
    read = (*structure.needed, *structure.optional, *structure.controls, *structure.frame_keys)
    inputs = {key: entries[key] for key in read if key in entries}
    inputs.update({key: value for key, value in entries.items() if key[0] == "noise"})
    head = {key: value.narrow(time, 0, 1) for key, value in entries.items()}
    one = torch.Size((*size[:-1], 1))
    if stored:
        starts = structure.completed({key: entries[key] for key in carry}, entries)
    elif marks is None and not resumed:  # only the first element needs an initial belief
        starts = start_of(head, call._replace(batch_size=one))
    else:
        starts = start_of(entries, call)
    device = starts[carry[0]].device
    begins = torch.ones(*one, 1, dtype=torch.bool, device=device) if marks is None else _or_first(marks, size, device)
    if resumed:  # a policy's data: each step starts from the stored previous belief
        if not all(previous_key(key) in entries for key in structure.required_controls):
            diagnosis().check_actions(structure, entries)
        first = _or_first(marks, size, device)
        known = entries.get(HAS_PREVIOUS, torch.ones_like(first))
        begins, inputs[FROM_STORED] = ~known, first & known
        inputs.update({previous_key(key): entries[previous_key(key)] for key in carry})
    inputs.update(controls_of(structure, entries, time))
    before = {key: starts[key].select(time, 0) for key in carry}
    return StepInputs(size, inputs, begins, starts, stored, before)


def controls_of(structure: Structure, entries: Entries, time: int) -> Entries:
    """Returns the controls of the step to each time; data have them one step earlier.

    Args:
        structure: structure of the filter.
        entries: entries of a sequence.
        time: the dimension of time.
    """
    moved = {key: one_earlier(entries[key], time) for key in structure.controls if key in entries}
    return moved | {key: entries[previous_key(key)] for key in structure.controls if previous_key(key) in entries}


def _or_first(marks: Tensor | None, size: torch.Size, device: torch.device) -> Tensor:
    """Marks ``[*B, T, 1]`` the given elements, and the first element of each sequence."""
    first = torch.zeros(*size, 1, dtype=torch.bool, device=device)
    first.narrow(len(size) - 1, 0, 1).fill_(True)
    return first if marks is None else first | marks.reshape(*size, 1)
