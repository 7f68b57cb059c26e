"""The part of a filter that goes from step to step: forecast, update, resets; on tensordicts or on rows of tensors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import expand_as_right

from torch_denkf.modules._row import Row, RowPlan, on_rows

__all__ = ["Recursion", "run", "where_rows"]

Entries = TypeVar("Entries", Row, TensorDictBase)


def run(modules: Iterable[TensorDictModuleBase], entries: Entries) -> Entries:
    """Calls the modules one after the other."""
    for module in modules:
        entries = module(entries)
    return entries


def where_rows(mask: torch.Tensor, new: torch.Tensor, old: torch.Tensor) -> torch.Tensor:
    """Takes ``new`` in the rows that ``mask`` ``[*B]`` or ``[*B, 1]`` marks, ``old`` ``[*B, ...]`` in the others."""
    return torch.where(expand_as_right(mask, old), new, old)


class Recursion:
    """Transition and update of a filter, looked up once a sequence.

    Args:
        modules: the transition, then those of the update.
        carry_keys: what goes on to the next step.
        belief_keys: what the initial belief gives and the update writes.
        forecast_of: the forecast of each carried entry.
        out_keys: all that the modules write.
        update_at_reset: whether an initial belief is updated with its frame.
        plans: of the transition and of the update, from an earlier recursion of the same modules.

    Attributes:
        on_rows: whether all modules run on a :class:`~torch_denkf.modules._row.Row`; if not, they need a TensorDict.
    """

    def __init__(
        self,
        modules: Sequence[TensorDictModuleBase],
        *,
        carry_keys: Sequence[NestedKey],
        belief_keys: Sequence[NestedKey],
        forecast_of: dict[NestedKey, NestedKey],
        out_keys: Sequence[NestedKey],
        update_at_reset: bool,
        plans: tuple[RowPlan | None, RowPlan | None] = (None, None),
    ):
        self.modules = tuple(modules)
        transition, update = self.plans = on_rows(modules[:1], plans[0]), on_rows(modules[1:], plans[1])
        self.on_rows = transition is not None and update is not None
        self.transition = transition.modules if self.on_rows else tuple(modules[:1])
        self.update = update.modules if self.on_rows else tuple(modules[1:])
        self.carry_keys, self.belief_keys, self.out_keys = tuple(carry_keys), tuple(belief_keys), tuple(out_keys)
        self.forecast_of, self.update_at_reset = dict(forecast_of), update_at_reset

    def first(self, row: Entries, start: Entries) -> Entries:
        """The first step of a sequence: its belief is ``start``; the update is made if that is to see its frame."""
        for key in self.carry_keys:
            row.set(key, start.get(key))
        for key, forecast_key in self.forecast_of.items():
            row.set(forecast_key, start.get(key))
        row = run(self.update, row)
        if not self.update_at_reset:
            for key in dict.fromkeys((*self.belief_keys, *self.carry_keys)):
                row.set(key, start.get(key))
        return row

    def advance(self, row: Entries, reset: torch.Tensor | None, start: Entries | None) -> Entries:
        """One step, except that rows in ``reset`` forecast their ``start``, and believe it."""
        row = run(self.transition, row)
        if reset is None:
            return run(self.update, row)
        for key, forecast_key in self.forecast_of.items():
            row.set(forecast_key, where_rows(reset, start.get(key), row.get(forecast_key)))
        for key in self.carry_keys:
            if key not in self.forecast_of:
                row.set(key, where_rows(reset, start.get(key), row.get(key)))
        row = run(self.update, row)
        if not self.update_at_reset:
            for key in self.belief_keys:
                row.set(key, where_rows(reset, start.get(key), row.get(key)))
        return row

    def roll(
        self,
        belief: Entries,
        rows: Sequence[Entries],
        resets: Sequence[torch.Tensor] | None,
        starts: Sequence[Entries],
        cuts: Sequence[bool],
    ) -> tuple[Entries, list[Entries]]:
        """Advances through ``rows``, one a step.

        Args:
            belief: the carry before the first of them.
            rows: what each step reads beside the carry.
            resets: which rows start anew at each step; ``None`` for none ever.
            starts: their beliefs, read only with ``resets``.
            cuts: where the belief is detached before the step.

        Returns:
            The carry after the last step, and what each step wrote.
        """
        outputs = []
        for t, row in enumerate(rows):
            row.update(belief.detach() if cuts[t] else belief)
            row = self.advance(row, None, None) if resets is None else self.advance(row, resets[t], starts[t])
            belief = row.select(*self.carry_keys)
            outputs.append(row.select(*self.out_keys))
        return belief, outputs
