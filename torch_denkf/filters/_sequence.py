"""A whole sequence: frames first, all at once; then one step after the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from torch_denkf.filters._ceiling import look_at_ceiling
from torch_denkf.filters._checks import (
    check_inputs,
    refuse_absurd_readings,
    refuse_far_belief,
    refuse_missing_actions,
)
from torch_denkf.filters._entries import own, write
from torch_denkf.filters._noise import draw_noise
from torch_denkf.filters._rejection import REJECTED
from torch_denkf.filters._said import say_ignored_mask
from torch_denkf.filters._slices import as_rows, starts_of
from torch_denkf.filters._steps import Steps, blank
from torch_denkf.filters._structure import KNOWN, Structure, previous_key
from torch_denkf.filters._summaries import summaries
from torch_denkf.modules._call import Call, Entries

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["Rows", "filter_rows", "filter_sequence", "stepped"]


class Rows(NamedTuple):
    """What the steps of a sequence read.

    Attributes:
        size: ``[*B, T]``.
        inputs: entries ``[*B, T, ...]``, with their noise as far as it was drawn.
        begins: elements that start from ``starts``, ``[*B, T, 1]``; ``None`` for the first alone.
        starts: initial or stored beliefs ``[*B, T]``, or ``[*B, 1]`` where ``begins`` is ``None``.
        resumed: whether the first element, too, is a step, from the belief before it.
        detach_every: the belief is detached every so many steps.
        keep: what to return of each step.
    """

    size: torch.Size
    inputs: Entries
    begins: Tensor | None
    starts: Entries
    resumed: bool
    detach_every: int | None
    keep: tuple[NestedKey, ...]


def filter_sequence(
    filter: Filter, tensordict: TensorDictBase, detach_every: int | None, keep: Sequence[NestedKey] | None
) -> TensorDictBase:
    """See :meth:`Filter.sequence`."""
    size = tensordict.batch_size
    if not size or not size[-1]:
        raise ValueError(
            "A sequence has time as its last batch dimension, and at least one step; this tensordict has "
            f"batch_size {list(size)}."
        )
    inner = {filter.outer(key): key for key in (*filter.structure.frame_keys, *filter.steps().step_keys)}
    keep = list(inner.values()) if keep is None else [inner.get(key, key) for key in map(unravel_key, keep)]
    unknown = [key for key in keep if key not in inner.values()]
    if unknown:
        raise ValueError(f"keep names {unknown}; the filter writes {list(inner)}.")
    new = starts_of(tensordict, filter.init_key)
    rows, new = as_rows(tensordict, new)
    outputs = filter_rows(filter, rows, new, detach_every, keep)
    if filter.compiled is not None:
        look_at_ceiling(filter, outputs)
    if rows is not tensordict:
        outputs = {key: value.flatten(0, 1) for key, value in outputs.items()}
    write(filter, tensordict, {key: outputs[key] for key in keep})
    return tensordict


def stepped(filter: Filter, tensordict: TensorDictBase) -> Tensor:
    """See :meth:`Filter.stepped`."""
    size = tensordict.batch_size
    new, first = starts_of(tensordict, filter.init_key), torch.zeros(size, dtype=torch.bool, device=tensordict.device)
    first[..., 0] = True
    new = first if new is None else first | new.reshape(size)
    if all(tensordict.get(filter.outer(previous_key(key)), None) is not None for key in filter.structure.carry):
        known = tensordict.get(
            filter.outer(KNOWN), None
        )  # a policy's data: every element with a belief before it is a step
        return torch.ones_like(new) if known is None else known.reshape(size)
    return ~new


def filter_rows(
    filter: Filter, rows: TensorDictBase, new: Tensor | None, detach_every: int | None, keep: Sequence[NestedKey]
) -> Entries:
    """The outputs ``keep`` of a sequence ``[*B, T]``.

    Args:
        filter: the filter.
        rows: frames, and what else its modules read.
        new: marks of first elements, see :func:`~torch_denkf.filters._slices.starts_of`.
        detach_every: the belief is detached every so many steps.
        keep: keys.
    """
    structure, time, size = filter.structure, rows.ndim - 1, rows.batch_size
    entries, call = filter.entries_of(rows), Call(size, time=True)
    given = list(entries.values())
    check_inputs(filter, entries, rows, carry=False)
    if filter.check_finite and not filter.reject and not torch.compiler.is_compiling():
        refuse_far_belief(entries, [name for key in structure.carry for name in (key, previous_key(key))])
        refuse_absurd_readings(structure, entries)
    say_ignored_mask(filter, rows)
    entries = filter.steps().usable(entries, call)
    with set_recurrent_mode(True):  # for modules that are not this package's
        frames = filter.steps().frames(entries, call)
    entries.update(frames)

    resumed = all(previous_key(key) in entries for key in structure.carry)
    stored = not resumed and all(key in entries for key in structure.carry)
    begins, fresh = new, None
    resumes: Entries = {}
    if resumed:
        begins, resumes = _beginnings(structure, entries, new, size)
        fresh = begins
    if stored:  # these have seen their frame
        starts = summaries(filter, {key: entries[key] for key in structure.carry}, entries)
    elif begins is None:  # where only the first element starts, only its initial belief is needed
        head = {key: value.narrow(time, 0, 1) for key, value in entries.items()}
        starts = filter.initial_belief(head, call._replace(batch_size=torch.Size((*size[:-1], 1))))
    else:
        starts = filter.initial_belief(entries, call)
    steps = filter.steps(filter.update_at_reset and not stored)

    reads = (*structure.needed, *structure.optional, *structure.controls, *structure.frame_keys, REJECTED)
    inputs = {key: entries[key] for key in reads if key in entries}
    inputs.update({key: value for key, value in entries.items() if key[0] == "noise"})
    inputs.update({key: entries[previous_key(key)] for key in structure.controls if previous_key(key) in entries})
    inputs.update(resumes)
    drawn = draw_noise(filter, {**entries, **starts}, size, (structure.transition, *structure.update), time=True)
    inputs.update(drawn or {})
    for key in structure.controls:  # stored one step earlier than they are read
        if previous_key(key) not in entries and key in inputs:
            value = inputs[key]
            inputs[key] = torch.cat([value.narrow(time, 0, 1), value.narrow(time, 0, size[-1] - 1)], time)
    step_keys = tuple(key for key in keep if key in steps.step_keys)
    todo = Rows(size, inputs, begins, starts, resumed, detach_every, step_keys)
    compiled = filter.compiled if drawn is not None and not resumed else None
    with set_recurrent_mode(False):
        outputs = _eagerly(steps, todo) if compiled is None else compiled.sequence(steps, todo)
    if fresh is None:
        fresh = _or_first(begins, size, next(iter(starts.values())).device)
    blank(steps, outputs, fresh)
    return {**own({key: frames[key] for key in keep if key in frames}, given), **outputs}


def _or_first(marks: Tensor | None, size: torch.Size, device: torch.device) -> Tensor:
    """Marks ``[*B, T, 1]``, and the first element of each sequence."""
    first = torch.zeros(*size, 1, dtype=torch.bool, device=device)
    first.narrow(len(size) - 1, 0, 1).fill_(True)
    return first if marks is None else first | marks.reshape(*size, 1)


def _beginnings(structure: Structure, entries: Entries, new: Tensor | None, size) -> tuple[Tensor, Entries]:
    """Which elements of a policy's data start anew, and what the others resume from where a slice begins."""
    refuse_missing_actions(structure, entries, resumed=True)
    new = _or_first(new, size, entries[previous_key(structure.carry[0])].device)
    known = entries.get(KNOWN, torch.ones_like(new))
    resumes = {previous_key(key): entries[previous_key(key)] for key in structure.carry}
    return ~known, {**resumes, ("previous", "resumes"): new & known}


def _eagerly(steps: Steps, todo: Rows) -> Entries:
    """What steps write on a sequence, ``[*B, T, ...]`` each."""
    time, cut = len(todo.size) - 1, todo.detach_every
    first = {key: todo.starts[key].select(time, 0) for key in steps.structure.carry} if todo.resumed else None
    cuts = [cut is not None and t > 0 and t % cut == 0 for t in range(todo.size[-1])]
    call = Call(torch.Size(todo.size[:-1]))
    return steps.scan(first, todo.inputs, call, todo.begins, todo.starts, cuts, todo.keep)[1]
