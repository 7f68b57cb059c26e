"""The steps of a filter, one after the other, on flat dictionaries of tensors, to be run, compiled or exported."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from typing import NamedTuple

import torch
from tensordict import NestedKey, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor

from torch_denkf._registered import compiler
from torch_denkf.filters.structure import FROM_STORED, Placed, Structure, previous_key, takes_reading
from torch_denkf.functional.kernels.small_system import on_gpu
from torch_denkf.running import is_sequence, named_modules_of, reads, run_module
from torch_denkf.submodel import Call, Entries, Transition, Update, role

__all__ = ["Steps", "where_rows"]


def where_rows(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Takes ``new`` in the rows that ``mask`` ``[*B]`` or ``[*B, 1]`` marks, ``old`` ``[*B, ...]`` in the others."""
    return torch.where(expand_as_right(mask, old), new, old)


class Steps(NamedTuple):
    """The steps of a filter, run eagerly; other strategies may replace them.

    Attributes:
        structure: the modules.
        update_at_reset: whether the initial belief is updated with its frame.
    """

    structure: Structure
    update_at_reset: bool

    def run(self, modules: Iterable[Placed], entries: Entries, call: Call, partial: bool = False) -> Entries:
        """Runs modules one after the other; each reads the outputs of those before it from ``entries``.

        If the entries are ``partial``, some observations are missing: modules that need them are skipped, and an
        update gets a mask instead.
        """
        written: Entries = {}
        for place, module in modules:
            part = call._replace(place=place) if call.place == "self" else call.part(place)
            if not partial or all(key in entries for key in reads(module)[0]):
                out = run_module(module, entries, part)
            elif is_sequence(module):
                out = self.run(named_modules_of(module), dict(entries), part, partial)
            elif takes_reading(module):
                out = run_module(module, _masked(module, entries, call), part)
            else:
                continue
            names = self.structure.own_info.get(place)
            if names is not None:
                out = {names.get(key, key): value for key, value in out.items()}
            entries.update(out)
            written.update(out)
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
        partial: bool = False,
    ) -> Entries:
        """Takes one step on ``[*B]``: frames, transition, update.

        Args:
            entries: the carry, which is the belief at t-1, and the frame of t.
            call: batch size, and whether noise is drawn.
            frames: whether the modules that read frames run; if not, ``entries`` have their outputs.
            reset: rows ``[*B]`` or ``[*B, 1]`` to reset: forecast and posterior become ``start``; ``None`` for none.
            start: initial beliefs, or a function of the entries that returns them; used only with ``reset``.
            forecast: replaces the transition.
            partial: whether observations are missing among the entries, see :meth:`run`.

        Returns:
            The entries that the modules write.

        Raises:
            KeyError: if no module writes the belief when observations are missing.
        """
        structure, entries = self.structure, dict(entries)
        written = self.run(structure.frames, entries, call, partial) if frames and structure.frames else {}
        begin = start or {} if start is None or isinstance(start, dict) else start(entries)
        if forecast is None:
            if reset is not None:
                # Before the transition, too: after a diverged episode its gradient would be NaN.
                entries.update({key: where_rows(reset, begin[key], entries[key]) for key in structure.carry})
            place, transition = structure.transition
            forecast = run_module(transition, entries, call._replace(place=place))
            if reset is not None:
                for key, name in structure.forecast_of.items():
                    forecast[name] = where_rows(reset, begin[key], forecast[name])
        entries.update(forecast)
        written.update(forecast)
        written.update(self.run(structure.posterior, entries, call, partial))
        for key, parts in structure.totals.items():
            if all(part in written for part in parts):
                written[key] = sum((written[part] for part in parts[1:]), written[parts[0]])
        if partial and not all(key in written for key in structure.carry):
            raise KeyError(
                f"Without the missing entries no module writes {list(structure.carry)}: give a mask of the missing "
                "observation, or let the analysis declare its reading_keys and its observed_key."
            )
        if reset is not None and not self.update_at_reset:
            for key in structure.belief:
                written[key] = where_rows(reset, begin[key], written[key])
        return written

    def begin(self, entries: Entries, call: Call, start: Entries, partial: bool) -> Entries:
        """Updates an initial belief with its frame, without a transition, as there may be no action yet."""
        structure, transition = self.structure, self.structure.transition[1]
        entries = {**entries, **{key: start[key] for key in structure.carry}}
        forecast = {name: start[key] for key, name in structure.forecast_of.items()}
        forecast |= role(transition, Transition).without_step(entries)
        every = torch.ones(*call.batch_size, 1, dtype=torch.bool, device=next(iter(start.values())).device)
        return self.step(entries, call, frames=False, reset=every, start=start, forecast=forecast, partial=partial)

    def scan(
        self,
        carry: Entries,
        inputs: Entries,
        call: Call,
        resets: Tensor | None,
        starts: Entries,
        cuts: Sequence[bool],
        keep: Sequence[NestedKey],
    ) -> tuple[Entries, Entries]:
        """Runs the steps one after the other.

        Args:
            carry: the belief before the first step.
            inputs: inputs of each step in addition to the carry, ``[*B, T, ...]``, with outputs of the frames' modules.
                Rows that :data:`FROM_STORED` marks start from the belief stored under ``("previous", ...)``.
            call: the call of one step ``[*B]``.
            resets: rows that are reset at each step, ``[*B, T, 1]``; ``[*B, 1, 1]`` if only the first step has
                some; ``None`` for none.
            starts: beliefs of the reset rows, ``[*B, T, ...]`` or ``[*B, 1, ...]``.
            cuts: T flags, whether the belief is detached before the step.
            keep: outputs of each step to return.

        Returns:
            The carry after the last step, and the outputs of the steps, ``[*B, T, ...]``.
        """
        time, outputs = len(call.batch_size), []
        rows = _unbound(inputs, time, len(cuts))
        marks = () if resets is None else resets.unbind(time)
        begins = _unbound(starts, time, len(marks))
        trained = torch.is_grad_enabled() and not torch.compiler.is_compiling() and on_gpu(next(iter(carry.values())))
        with compiler().sharing() if trained else nullcontext():
            for t, row in enumerate(rows):
                if cuts[t]:
                    carry = {key: value.detach() for key, value in carry.items()}
                if FROM_STORED in row:
                    carry = {
                        key: where_rows(row[FROM_STORED], row[previous_key(key)], value) for key, value in carry.items()
                    }
                reset, start = (marks[t], begins[t]) if t < len(marks) else (None, None)
                out = self.step({**row, **carry}, call, frames=False, reset=reset, start=start)
                carry = {key: out[key] if key in out else row[key] for key in self.structure.carry}
                outputs.append(out)
        return carry, {key: torch.stack([out[key] for out in outputs], time) for key in keep}

    def blank(self, written: Entries, fresh: Tensor) -> None:
        """Sets step outputs that an initial belief lacks, such as innovations, to zero.

        Args:
            written: outputs of a step, or of the steps of a sequence; changed in place.
            fresh: elements that are reset to an initial or stored belief, ``[*B, 1]`` or ``[*B, T, 1]``.
        """
        structure = self.structure
        at_start = (*structure.carry, *structure.belief, *structure.forecast_of.values())
        for key in structure.beside if self.update_at_reset else structure.step_keys:
            if key in written and key not in at_start:
                written[key] = where_rows(fresh, written[key].new_zeros(()), written[key])


def _unbound(entries: Entries, time: int, count: int) -> list[Entries]:
    """Splits entries by time, ``[*B, T, ...]``."""
    columns = {key: value.unbind(time) for key, value in entries.items()}
    return [{key: column[t] for key, column in columns.items()} for t in range(count)]


def _masked(module: Update, entries: Entries, call: Call) -> Entries:
    """Returns the entries with ones in place of missing observations, and a mask of them."""
    like = next(entries[key] for key in module.in_keys if key in entries)
    dims = zip(module.reading_keys, module.reading_dims(entries, call), strict=True)
    ones = {
        unravel_key(key): like.new_ones(*call.batch_size, *torch.Size([dim] if isinstance(dim, int) else dim))
        for key, dim in dims
    }
    mask = torch.zeros(*call.batch_size, 1, dtype=torch.bool, device=like.device)
    return {**ones, **entries, module.observed_key: mask}
