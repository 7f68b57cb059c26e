"""Refiltering of delayed readings: repeats the steps since their measurement, with the same noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torch_denkf._arguments import Checked
from torch_denkf._checks import check_count, check_mask, check_shape
from torch_denkf._slices import starts_of
from torch_denkf.filters.base import Filter
from torch_denkf.filters.scan import where_rows
from torch_denkf.fusion.parts import StateObservation

__all__ = ["Refiltering", "RefilteringWindow"]


class RefilteringWindow(NamedTuple):
    """Window of the last steps of a filter.

    Attributes:
        rows: inputs of each step, with its noise and the delayed readings of its time; the oldest first.
        beliefs: belief before the first step, and the outputs of each step.
    """

    rows: tuple[TensorDictBase, ...]
    beliefs: tuple[TensorDictBase, ...]

    @property
    def belief(self) -> TensorDictBase:
        """Returns the belief of the last step."""
        return self.beliefs[-1]


class Refiltering(Checked):
    """Repeats the last steps when a delayed reading arrives, with any filter.

    Up to rounding, the belief equals that of a filter with all readings in order, also for ensembles with process noise
    and for particles, as each step keeps its noise. A step without a delayed reading costs one step of the filter, a
    step with a reading of k steps ago costs k + 1. A :class:`FusedFilter` with a ``delay`` corrects the later states by
    their covariances instead, at a cost independent of the delay; for an ensemble with process noise these are sample
    covariances. That filter also runs as a policy and in a transform.

    It is no :class:`Filter`, and must be the outermost wrapper: ``Refiltering(Gated(FixedLag(filter, 10)), late,
    lag)``.

    All rows of the batch begin their episode together. A reading is not used if it was taken before the first step, or
    more than ``lag`` steps ago. It replaces the sensor's previous reading of that time.

    Args:
        filter: filter whose sensors have no ``delay``.
        late: maps the key of each delayed sensor's latency in steps, ``[*B, 1]`` int64, to the keys of its reading and
            other entries to move with it, the last of them its mask ``[*B, 1]`` or ``[*B, O]``.
        lag: largest latency of a reading in steps.

    Raises:
        ValueError: if ``lag`` is not positive, the filter updates its first belief or has a sensor with a ``delay``, or
            ``late`` names an entry that the filter does not read, or no reading with its mask.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
        >>> late = Refiltering(kf, {"late": ("observation", "observed")}, lag=2)
        >>> drive = TensorDict({"observation": torch.tensor([[0.0], [0.0], [3.0], [5.0]])}, [4])
        >>> drive["late"] = torch.tensor([[0], [0], [0], [2]])  # the last one was measured two steps before, at t = 1
        >>> drive["observed"] = torch.tensor([[False], [False], [True], [True]])
        >>> order = TensorDict({"observation": torch.tensor([[0.0], [5.0], [3.0], [0.0]])}, [4])
        >>> order["observed"] = torch.tensor([[False], [True], [True], [False]])
        >>> torch.equal(late.sequence(drive)["belief", "mean"][-1], kf.sequence(order)["belief", "mean"][-1])
        True
    """

    def __init__(self, filter: Filter, late: Mapping[NestedKey, tuple[NestedKey, ...]], lag: int):
        check_count("lag", lag)
        if filter.update_at_reset:
            raise ValueError("The filter has update_at_reset=True, and a reading of the first frame could come late.")
        models = [module for module in filter.modules() if isinstance(module, StateObservation)]
        if any(model.delay or model.late_key is not None for model in models):
            raise ValueError(
                "A sensor of the filter has a delay= or late_key=, and would be late twice; leave them out."
            )
        self.filter, self.lag = filter, lag
        self.late = {unravel_key(key): _read_with(key, keys, filter) for key, keys in late.items()}

    def start(self, row: TensorDictBase | Mapping[str, Any]) -> RefilteringWindow:
        """Returns the window at the start of an episode: no steps yet, and the initial belief.

        Args:
            row: inputs of :meth:`Filter.initialise`, ``[*B]``.

        Returns:
            The window, whose ``belief`` is the initial one.
        """
        return RefilteringWindow((), (self.filter.initialise(self.filter.of_one_robot(row).copy()),))

    def step(self, window: RefilteringWindow, row: TensorDictBase | Mapping[str, Any]) -> RefilteringWindow:
        """Runs one step.

        Args:
            window: the last steps; it is not changed.
            row: inputs of :meth:`Filter.step`, ``[*B]``, besides the belief.

        Returns:
            The window with this step, whose ``belief`` is that of t.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if a module draws its noise only within the step, the row begins another episode, or an entry of
                ``late`` is no integer tensor ``[*B, 1]``.
        """
        row = self.filter.of_one_robot(row)
        begins = starts_of(row, self.filter.init_key, step=True)
        if begins is not None and begins.any():
            raise ValueError(f"{self.filter.init_key!r} marks a row that begins another episode; take it to start().")
        rows = [*window.rows, self._with_noise(row, window.belief)][-self.lag - 1 :]
        beliefs = list(window.beliefs[-len(rows) :])
        first = self._place(rows)
        del beliefs[first + 1 :]
        for row in rows[first:]:
            out = self.filter.step(row.copy().update(beliefs[-1].select(*self.filter.carry_keys)))
            beliefs.append(out.select(*self.filter.out_keys))
        return RefilteringWindow(tuple(rows), tuple(beliefs))

    def sequence(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Filters one episode ``[*B, T]`` and writes the outputs of each step before later corrections.

        Raises:
            ValueError: if another episode begins within it.
        """
        time, controls = tensordict.ndim - 1, self.filter.structure.controls
        begins = starts_of(tensordict, self.filter.init_key)
        if begins is not None and begins.narrow(time, 1, begins.shape[time] - 1).any():
            raise ValueError("Another episode begins within the sequence; cut it there.")
        rows = tensordict.unbind(time)
        window = self.start(rows[0])
        beliefs = [window.belief]
        for before, row in pairwise(rows):
            window = self.step(window, row.copy().update(before.select(*controls, strict=False)))
            beliefs.append(window.belief)
        for key in self.filter.out_keys:
            like = beliefs[-1].get(key)
            values = [belief.get(key, None) for belief in beliefs]
            tensordict.set(key, torch.stack([torch.zeros_like(like) if v is None else v for v in values], time))
        return tensordict

    def _with_noise(self, row: TensorDictBase, belief: TensorDictBase) -> TensorDictBase:
        """Returns the row and all noise of its step."""
        row = row.copy()
        carry = {key: belief[key] for key in self.filter.carry_keys}
        entries = {**self.filter.entries_of(row, one_step=True), **carry}
        self.filter.write(row, self.filter.draws.missing(entries, row.batch_size))
        return row

    def _place(self, rows: list[TensorDictBase]) -> int:
        """Moves the delayed readings of the last row to their rows of measurement; returns the first changed row."""
        last = len(rows) - 1
        first = last
        for key, keys in self.late.items():
            late, mask = rows[last][key], keys[-1]
            _check_late(key, late, rows[last])
            check_mask(str(mask), rows[last][mask])
            for steps in range(1, last + 1):
                here = (late == steps) & rows[last][mask].any(-1, keepdim=True)
                if here.any():
                    first = min(first, last - steps)
                    old = rows[last - steps]
                    new = {name: where_rows(here, rows[last][name], old[name]) for name in keys}
                    rows[last - steps] = old.copy().update(new)
            rows[last] = rows[last].copy().set(mask, rows[last][mask] & (late == 0))
        return first


def _read_with(key: NestedKey, keys: Sequence[NestedKey], filter: Filter) -> tuple[NestedKey, ...]:
    """Returns the keys of a reading and of its mask, which the filter must read."""
    if isinstance(keys, str) or len(keys) < 2:
        raise ValueError(f"late[{key!r}] is the keys of a reading and, last, of its mask; got {keys!r}.")
    found = tuple(map(unravel_key, keys))
    for one in found:
        if one not in filter.in_keys:
            raise ValueError(f"late[{key!r}] names {one!r}, which the filter does not read; it reads {filter.in_keys}.")
    return found


def _check_late(key: NestedKey, late: Tensor, row: TensorDictBase) -> None:
    """Raises unless an entry is a latency in whole steps."""
    check_shape(str(key), late, (*row.batch_size, 1), "[*B, 1]")
    if late.is_floating_point() or late.dtype == torch.bool:
        raise ValueError(f"{key!r} holds steps, as int64; got {late.dtype}. Pass {key}.long().")
