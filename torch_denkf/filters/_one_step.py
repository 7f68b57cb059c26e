"""One step in each of its forms: in a loop, without a frame, inside a policy, and the first of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import TYPE_CHECKING

import torch
from tensordict import NestedKey, TensorDictBase

from torch_denkf.filters._ceiling import look_at_ceiling
from torch_denkf.filters._checks import (
    check_inputs,
    refuse_missing_actions,
    refuse_non_finite,
    refuse_single_readings,
    refuse_unknown_readings,
)
from torch_denkf.filters._entries import own, write
from torch_denkf.filters._noise import draw_noise
from torch_denkf.filters._said import mark_carried, say_eager, say_foreign, say_ignored_mask, say_up_to_date
from torch_denkf.filters._slices import starts_of
from torch_denkf.filters._steps import blank, where_rows
from torch_denkf.filters._structure import KNOWN, previous_key, submodels
from torch_denkf.filters._summaries import summaries
from torch_denkf.modules._call import Call, Entries
from torch_denkf.modules._running import reads, run_module

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["first_belief", "initial_belief", "policy_step", "step", "step_without_frame", "take_step"]


def step(filter: Filter, tensordict: TensorDictBase, without: Sequence[NestedKey]) -> TensorDictBase:
    """See :meth:`Filter.step`."""
    structure = filter.structure
    if without:
        without = refuse_unknown_readings(structure, without)
        refuse_single_readings(structure, without)
    entries = filter.entries_of(tensordict, one_step=True)
    check_inputs(filter, entries, tensordict, without)
    if without:
        say_eager(
            filter,
            "predict() and step(without=...) leave readings out.",
            "Hide what is missing with a mask instead, which keeps the step compiled.",
        )
        entries = {key: value for key, value in entries.items() if key not in without}
        written = filter.steps().take(entries, Call(tensordict.batch_size), missing=without)
        lost = [key for key in structure.carry if key in structure.step_keys and key not in written]
        if lost:
            raise KeyError(f"Without {list(without)} no module writes {lost}; give a mask that hides the reading.")
    else:
        say_ignored_mask(filter, tensordict)
        written = filter.take_step(entries, tensordict.batch_size)
    if filter.check_finite and not torch.compiler.is_compiling():
        refuse_non_finite(structure, entries, written, filter.reject)
    write(filter, tensordict, own(written, entries.values()))
    return tensordict


def step_without_frame(filter: Filter, tensordict: TensorDictBase) -> TensorDictBase:
    """See :meth:`Filter.predict`."""
    hidden = tensordict.copy()
    for key in dict.fromkeys(part.mask_key for part in submodels(filter.module) if part.mask_key is not None):
        hidden.set(key, torch.zeros(*tensordict.batch_size, 1, dtype=torch.bool, device=tensordict.device))
    out = filter.step(hidden, without=filter.structure.readings)
    written = [key for key in filter.out_keys if out.get(key, None) is not None]
    return tensordict.update(out.select(*written))


def policy_step(filter: Filter, tensordict: TensorDictBase) -> TensorDictBase:
    """A step from the belief under ``("previous", ...)``, or the initial one; see :meth:`Filter.forward`."""
    structure = filter.structure
    entries = filter.entries_of(tensordict)
    given = list(entries.values())
    resumed = all(previous_key(key) in entries for key in structure.carry)
    refuse_missing_actions(structure, entries, resumed)
    for key in (*structure.carry, *structure.controls):
        if previous_key(key) in entries:
            entries[key] = entries[previous_key(key)]
    check_inputs(filter, entries, tensordict)
    say_ignored_mask(filter, tensordict)
    say_up_to_date(filter, entries[structure.carry[0]])
    say_foreign(filter, entries[structure.carry[0]])
    # A mark may be that of a slice of data, which goes on from the belief before it.
    known = entries.get(KNOWN)
    if known is None:
        reset = starts_of(tensordict, filter.init_key, step=True)
    else:
        reset = ~known.reshape(*tensordict.batch_size, 1)
    call, steps = Call(tensordict.batch_size), filter.steps()
    if reset is None:
        written = filter.take_step(entries, tensordict.batch_size)
    else:
        written = steps.take(entries, call, reset=reset, start_of=lambda now: filter.initial_belief(now, call))
        blank(steps, written, reset)
        # What went before does not count where an episode begins.
        entries.update({key: where_rows(reset, written[key], entries[key]) for key in structure.carry})
    if filter.check_finite and not torch.compiler.is_compiling():
        unread = None if filter.update_at_reset else reset
        refuse_non_finite(structure, entries, written, filter.reject, unread)
    some = written[structure.carry[0]]
    following = {("next", *previous_key(key)): written[key] for key in structure.carry}
    following["next", *KNOWN] = torch.ones(*tensordict.batch_size, 1, dtype=torch.bool, device=some.device)
    write(filter, tensordict, own({**written, **following}, given))
    mark_carried(filter, tensordict.get(filter.outer(("next", *previous_key(structure.carry[0])))))
    return tensordict


def take_step(filter: Filter, entries: Entries, batch_size: torch.Size, reject: bool | None = None) -> Entries:
    """See :meth:`Filter.take_step`."""
    structure, steps = filter.structure, filter.steps(reject=reject)
    if filter.compiled is not None:
        drawn = draw_noise(filter, entries, batch_size, structure.modules)
        if drawn is not None:
            written = filter.compiled.step(steps, {**entries, **drawn}, batch_size)
            look_at_ceiling(filter, written)
            return written
    return steps.take(entries, Call(batch_size))


def initial_belief(filter: Filter, entries: Entries, call: Call) -> Entries:
    """See :meth:`Filter.initial_belief`."""
    belief = filter.structure.belief
    hidden = {key: value for key, value in entries.items() if key not in belief}
    return own(summaries(filter, run_module(filter.initial, hidden, call.part("initial"))), entries.values())


def first_belief(
    filter: Filter, tensordict: TensorDictBase, without: Sequence[NestedKey] = (), reject: bool | None = None
) -> TensorDictBase:
    """See :meth:`Filter.initialise`; ``reject`` as the filter's."""
    entries, call, structure = filter.entries_of(tensordict), Call(tensordict.batch_size), filter.structure
    given = list(entries.values())
    missing, steps = set(refuse_unknown_readings(structure, without)), filter.steps(reject=reject)
    entries = steps.usable(entries, call)
    frame_keys, written = set(structure.frame_keys), {}
    if filter.update_at_reset or not frame_keys.isdisjoint(chain(*reads(filter.initial))):
        written = steps.frames(entries, call, missing)
        entries.update(written)
    entries = {key: value for key, value in entries.items() if key not in missing}
    start = filter.initial_belief(entries, call._replace(missing=frozenset(missing)))
    if filter.update_at_reset:
        written.update(steps.first(entries, call, start, in_sequence=False, missing=missing))
    else:
        written.update(start)
        written.update({forecast: start[key] for key, forecast in structure.forecast_of.items()})
    write(filter, tensordict, own(written, given))
    return tensordict
