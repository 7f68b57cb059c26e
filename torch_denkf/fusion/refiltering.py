"""Readings that come late, put where they belong: the steps since are made again, with the same noise."""

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
    """The last steps of a filter.

    Attributes:
        rows: the inputs of each step, with its noise and the readings that came later; the oldest first.
        beliefs: the belief before the first of them, and what each wrote.
    """

    rows: tuple[TensorDictBase, ...]
    beliefs: tuple[TensorDictBase, ...]

    @property
    def belief(self) -> TensorDictBase:
        """Returns the belief of the last step."""
        return self.beliefs[-1]


class Refiltering(Checked):
    """Filters the last steps once more when a reading comes late, with any filter.

    The belief is that of the filter which gets each reading when it is taken, to rounding, also for ensembles with
    process noise and for particles: each step keeps the noise that it drew. A step without a late reading costs a step
    of the filter, one with a reading of k steps ago k + 1. A :class:`FusedFilter` with a ``delay`` corrects the states
    since by their covariances instead, at a cost that does not depend on how late the reading is; of an ensemble with
    process noise they are sample covariances. That filter also runs as a policy and in a transform.

    It is no :class:`Filter`, and goes around all others: ``Refiltering(Gated(FixedLag(filter, 10)), late, lag)``.

    All rows of the batch begin their episode together. A reading is not used if it belongs to the time before the first
    step, or to more than ``lag`` steps ago. It takes the place of what its sensor had read at that time.

    Args:
        filter: whose sensors have no ``delay`` of their own.
        late: for each sensor that can be late the key of an entry ``[*B, 1]``, int64, by how many steps its reading
            is; and the keys of what comes with the reading, the last of them its mask ``[*B, 1]`` or ``[*B, O]``.
        lag: the largest number of steps by which a reading can be late.

    Raises:
        ValueError: if ``lag`` is not positive, the filter updates its first belief or has a sensor with a ``delay``, or
            ``late`` names what the filter does not read, or no reading with its mask.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
        >>> late = Refiltering(kf, {"late": ("observation", "observed")}, lag=2)
        >>> drive = TensorDict({"observation": torch.tensor([[0.0], [0.0], [3.0], [5.0]])}, [4])
        >>> drive["late"] = torch.tensor([[0], [0], [0], [2]])  # the last one was read two steps before, at t = 1
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
            ValueError: if a module can draw its noise only within the step, the row begins another episode, or an entry
                of ``late`` is not of whole numbers ``[*B, 1]``.
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
        """Puts the late readings of the last row where they belong; returns the first row that is another."""
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
    """Raises unless an entry says by how many steps a reading is late."""
    check_shape(str(key), late, (*row.batch_size, 1), "[*B, 1]")
    if late.is_floating_point() or late.dtype == torch.bool:
        raise ValueError(f"{key!r} holds steps, as int64; got {late.dtype}. Pass {key}.long().")
