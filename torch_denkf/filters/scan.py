"""The steps of a filter, one after the other, on flat dictionaries of tensors: what is run, compiled and exported."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from typing import NamedTuple

import torch
from tensordict import NestedKey, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor

from torch_denkf.filters.rejection import REJECTED, usable
from torch_denkf.filters.structure import RESUMES, Placed, Structure, previous_key, takes_reading
from torch_denkf.modules._held import hold_variances
from torch_denkf.running import is_sequence, named_modules_of, run_module
from torch_denkf.submodel import Call, Entries, Transition, Update, role

__all__ = ["Steps", "where_rows"]


def where_rows(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Takes ``new`` in the rows that ``mask`` ``[*B]`` or ``[*B, 1]`` marks, ``old`` ``[*B, ...]`` in the others."""
    return torch.where(expand_as_right(mask, old), new, old)


class Steps(NamedTuple):
    """The steps of a filter.

    Attributes:
        structure: its modules.
        update_at_reset: whether an initial belief is updated with its frame.
        ceiling: largest variance of the belief; ``None`` for any.
        say: told which variance is held at the ceiling.
        reject: whether readings that cannot be true count as not observed.
    """

    structure: Structure
    update_at_reset: bool
    ceiling: float | None
    say: Callable[[NestedKey], None]
    reject: bool = False

    @property
    def step_keys(self) -> tuple[NestedKey, ...]:
        """What transition and update write, and how many readings were rejected."""
        return (*self.structure.step_keys, REJECTED) if self.reject else self.structure.step_keys

    def guarded(self, entries: Entries, call: Call) -> Entries:
        """A copy of what the modules may read: without readings that cannot be true, if they are to be rejected."""
        size = len(call.batch_size)
        for key in self.structure.plain:
            value = entries.get(key)
            if value is not None and value.ndim > size + 1 + (key[-1] == "ensemble"):
                _refuse_groups(self.structure, key, entries, call.batch_size)
        return usable(self.structure.guards, entries, call.batch_size) if self.reject else dict(entries)

    def run(
        self,
        modules: Iterable[Placed],
        entries: Entries,
        call: Call,
        missing: AbstractSet[NestedKey] = frozenset(),
    ) -> Entries:
        """What modules write, one after the other; each finds in ``entries`` what those before it wrote.

        ``missing`` names what is not there, see :meth:`Structure.lost`. An analysis gets a mask in its place.
        """
        written: Entries = {}
        for place, module in modules:
            part = call._replace(place=place) if call.place == "self" else call.part(place)
            if not missing or missing.isdisjoint(module.in_keys):
                out = run_module(module, entries, part)
            elif is_sequence(module):
                out = self.run(named_modules_of(module), dict(entries), part, missing)
            elif takes_reading(module):
                out = run_module(module, _hidden(module, entries, call), part)
            else:
                continue
            names = self.structure.own_info.get(place)
            if names:
                out = {names.get(key, key): value for key, value in out.items()}
            entries.update(out)
            written.update(out)
        for key, parts in self.structure.totals.items():
            if all(part in written for part in parts):
                written[key] = sum((written[part] for part in parts[1:]), written[parts[0]])
        return written

    def step(
        self,
        entries: Entries,
        call: Call,
        *,
        frames: bool = True,
        reset: Tensor | None = None,
        start: Entries | Callable[[Entries], Entries] | None = None,
        forecast: Entries | None = None,
        missing: AbstractSet[NestedKey] = frozenset(),
    ) -> Entries:
        """One step on ``[*B]``: frames, transition, update.

        Args:
            entries: the carry, which is the belief at t-1, and the frame of t.
            call: batch size and whether noise is drawn.
            frames: whether the modules that read frames are to run; if not, ``entries`` hold what they wrote.
            reset: rows ``[*B]`` or ``[*B, 1]`` that forecast their ``start``, and believe it; ``None`` for none.
            start: initial beliefs, or what makes them of entries; read only with ``reset``.
            forecast: what the transition would write, in its place.
            missing: what is not among the entries, see :meth:`run`.

        Returns:
            What the modules write.
        """
        structure, written = self.structure, {}
        if missing and not missing.isdisjoint(structure.carry):
            raise KeyError(
                f"Without {sorted(map(str, missing))} no module writes {list(structure.carry)}: give a mask that hides "
                "the reading, or let the analysis name its reading_keys and its observed_key."
            )
        if frames:
            entries = self.guarded(entries, call)
            written = self.run(structure.frames, entries, call, missing)
        else:
            entries = dict(entries)
        begin = start or {} if start is None or isinstance(start, dict) else start(entries)
        if forecast is None:
            if reset is not None:
                # Before the transition, too: its gradient would be NaN where the episode before diverged.
                entries.update({key: where_rows(reset, begin[key], entries[key]) for key in structure.carry})
            forecast = self.run((structure.transition,), entries, call)
            if reset is not None:
                for key, name in structure.forecast_of.items():
                    forecast[name] = where_rows(reset, begin[key], forecast[name])
        entries.update(forecast)
        written.update(forecast)
        written.update(self.run(structure.update, entries, call, missing))
        if reset is not None and not self.update_at_reset:
            for key in structure.belief:
                written[key] = where_rows(reset, begin[key], written[key])
        if self.ceiling is not None:
            hold_variances(written, structure.belief, self.ceiling, self.say, structure.space)
        if self.reject:
            written[REJECTED] = entries[REJECTED]
        return written

    def first(
        self,
        entries: Entries,
        call: Call,
        start: Entries,
        *,
        in_sequence: bool = True,
        missing: AbstractSet[NestedKey] = frozenset(),
    ) -> Entries:
        """The first step of a sequence: its forecast is ``start``; it is updated if that is to see its frame."""
        structure = self.structure
        entries = {**entries, **{key: start[key] for key in structure.carry}}
        forecast = {name: start[key] for key, name in structure.forecast_of.items()}
        if structure.beside and in_sequence:  # their shapes follow from a step out of the start
            out = self.run((structure.transition,), dict(entries), call)
            forecast |= {key: torch.zeros_like(out[key]) for key in structure.beside}
        elif structure.beside:
            forecast |= role(structure.transition[1], Transition).without_step(entries)
        every = torch.ones(*call.batch_size, 1, dtype=torch.bool, device=next(iter(start.values())).device)
        return self.step(entries, call, frames=False, reset=every, start=start, forecast=forecast, missing=missing)

    def scan(
        self,
        carry: Entries | None,
        inputs: Entries,
        call: Call,
        resets: Tensor | None,
        starts: Entries,
        cuts: Sequence[bool],
        keep: Sequence[NestedKey],
    ) -> tuple[Entries, Entries]:
        """Takes one step after the other.

        Args:
            carry: the belief before the first step; ``None`` if the first element is where a sequence starts.
            inputs: what each step reads beside the carry, ``[*B, T, ...]``, with what the frames' modules wrote. What
                stands under ``("previous", ...)`` is where the step begins in rows that :data:`RESUMES` marks.
            call: of one step ``[*B]``.
            resets: which rows start anew at each step, ``[*B, T, 1]``; ``None`` for none but those of a start.
            starts: their beliefs, ``[*B, T, ...]``, or without ``resets`` that of the first element, ``[*B, 1, ...]``.
            cuts: where the belief is detached before the step, T.
            keep: what to return of each step.

        Returns:
            The carry after the last step, and what the steps wrote, ``[*B, T, ...]``.
        """
        time, outputs = len(call.batch_size), []
        rows = _unbound(inputs, time, len(cuts))
        begins = _unbound(starts, time, 1 if resets is None else len(cuts)) if starts else []
        marks = None if resets is None else resets.unbind(time)
        for t, row in enumerate(rows):
            if carry is None:
                out = self.first(row, call, begins[0])
            else:
                if cuts[t]:
                    carry = {key: value.detach() for key, value in carry.items()}
                if RESUMES in row:
                    carry = {
                        key: where_rows(row[RESUMES], row[previous_key(key)], value) for key, value in carry.items()
                    }
                reset, start = (None, None) if marks is None else (marks[t], begins[t])
                out = self.step({**row, **carry}, call, frames=False, reset=reset, start=start)
            carry = {key: out[key] if key in out else row[key] for key in self.structure.carry}
            outputs.append(out)
        return carry or {}, {key: torch.stack([out[key] for out in outputs], time) for key in keep}

    def blank(self, written: Entries, fresh: Tensor) -> None:
        """Zero for what a step writes, and a belief that starts does not have: innovations and the like.

        Args:
            written: by a step, or by those of a sequence; changed.
            fresh: elements that start from an initial or stored belief, ``[*B, 1]`` or ``[*B, T, 1]``.
        """
        structure = self.structure
        at_start = (*structure.carry, *structure.belief, *structure.forecast_of.values())
        for key in structure.beside if self.update_at_reset else self.step_keys:
            if key in written and key not in at_start:
                written[key] = where_rows(fresh, torch.zeros_like(written[key]), written[key])


def _unbound(entries: Entries, time: int, count: int) -> list[Entries]:
    """The entries of each time, of entries ``[*B, T, ...]``."""
    columns = {key: value.unbind(time) for key, value in entries.items()}
    return [{key: column[t] for key, column in columns.items()} for t in range(count)]


def _refuse_groups(structure: Structure, key: NestedKey, entries: Entries, batch_size: Sequence[int]) -> None:
    """Raises a ``ValueError`` where a raw reading has dimensions that neither the batch nor an ensemble has."""
    size, value = len(batch_size), entries[key]
    members = next((entries[k].shape[-2] for k in structure.carry if k[-1] == "ensemble" and k in entries), None)
    samples = key[-1] == "ensemble" or value.shape[-2:-1] == (members,)
    if value.ndim > size + 1 + samples:
        raise ValueError(
            f"The reading {key!r} is {list(value.shape)}, and the batch is {list(batch_size)}: {value.ndim - size - 1} "
            "dimension(s) too many. Readings of several robots need a belief for each: filter a tensordict whose batch "
            "holds the robots, such as tensordict['agents'] of a group. Readings of one robot: put them side by side, "
            "with flatten(-2). Samples of one reading: under a key whose last name is 'ensemble'."
        )


def _hidden(module: Update, entries: Entries, call: Call) -> Entries:
    """The entries with ones in the place of readings that are missing, and a mask that hides them."""
    like = next(entries[key] for key in module.in_keys if key in entries)
    dims = zip(module.reading_keys, module.reading_dims(entries, call), strict=True)
    ones = {unravel_key(key): like.new_ones(*call.batch_size, dim) for key, dim in dims}
    mask = torch.zeros(*call.batch_size, 1, dtype=torch.bool, device=like.device)
    return {**ones, **entries, module.observed_key: mask}
