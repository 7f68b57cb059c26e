"""Raises if a noise is no covariance, and warns if a sequence ends in NaN."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor

from torch_denkf._checks import flag_value
from torch_denkf.diagnosis.once import Once
from torch_denkf.diagnosis.reasons import (
    COVARIANCE,
    NoiseEntry,
    bad_inputs,
    cure_of,
    flaw_of,
    named,
    no_covariance,
    noises_of,
    reason,
)
from torch_denkf.filters.base import Filter
from torch_denkf.filters.finish import Record
from torch_denkf.filters.structure import Structure, previous_key
from torch_denkf.functional.kernels.small_system import on_gpu

__all__ = ["WrongNoise"]

#: Share of a row's largest variance that round-off may leave below zero.
_ROUNDING = 1e-4


class WrongNoise(Once):
    """Raises if the noise of a reading, or a variance of the belief, is negative, and warns of NaN in a sequence.

    Noise of missing observations is not checked. ``check_finite=False`` disables all checks.
    """

    def __init__(self) -> None:
        super().__init__()
        self._known: tuple[Structure | None, list[NoiseEntry], list[NestedKey]] = (None, [], [])

    def __call__(self, filter: Filter, record: Record) -> None:
        """Checks the inputs and outputs of a run.

        Raises:
            ValueError: that names the entry and the row.
        """
        if not filter.check_finite or on_gpu(next(iter(record.written.values()))):  # to look would wait
            return
        structure, dims = filter.structure, len(record.batch_size)
        if self._known[0] is not structure:
            variances = [kind.key("var") for kind in structure.kinds if not set(structure.carry).isdisjoint(kind.carry)]
            self._known = structure, noises_of(structure), variances
        for noise in self._known[1]:
            value = _found(record, noise.key)
            if value is None or value.ndim not in (dims + 1, dims + 2) or value.shape[:dims] != record.batch_size:
                continue
            if value.ndim == dims + 1 and not flag_value((value < 0).any()):
                continue
            mask = None if noise.mask is None else _found(record, noise.mask)
            wrong = no_covariance(value.detach(), mask, dims)
            if flag_value(wrong.any()):
                self._raise(filter, record, noise, value, mask, wrong)
        for key in self._known[2]:
            var = record.written.get(key)
            if var is not None and flag_value((var < 0).any()):
                wrong = (var < -_ROUNDING * var.abs().amax(-1, keepdim=True)).any(-1)
                if bool(wrong.any()):
                    self._raise_of_belief(filter, record, key, var, wrong)
        if record.way == "sequence" and "nan" not in self.said:
            self._warn_of_nan(filter, record)

    def _raise(
        self, filter: Filter, record: Record, noise: NoiseEntry, value: Tensor, mask: Tensor | None, wrong: Tensor
    ) -> None:
        if record.way == "sequence" and not filter.update_at_reset:
            wrong = wrong & filter.stepped(record.tensordict).reshape(wrong.shape)  # an initial belief reads no noise
            if not bool(wrong.any()):
                return
        row = tuple(wrong.nonzero()[0].tolist())
        flaw = flaw_of(value[row], None if mask is None else mask[row])
        where = f" in row {list(row)}" if row else ""
        raise ValueError(f"{named(filter.structure, noise.key)} is no covariance{where}: {flaw}. {COVARIANCE}")

    def _raise_of_belief(self, filter: Filter, record: Record, key: NestedKey, var: Tensor, wrong: Tensor) -> None:
        row = tuple(wrong.nonzero()[0].tolist())
        place, least = int(var[row].argmin()), float(var[row].detach().min())
        where = f" in row {list(row)}" if row else ""
        raise ValueError(
            f"The new belief has a negative variance in {key!r}{where}: component {place} is {least:g}. "
            f"The covariance that the step began with, {filter.carry_keys}, or a noise is none. {COVARIANCE}"
        )

    def _warn_of_nan(self, filter: Filter, record: Record) -> None:
        """Names the cause of the first NaN of a sequence, which continues to its end."""
        structure, dims = filter.structure, len(record.batch_size)
        made = [record.written.get(kind.key(name)) for kind in structure.kinds for name in ("mean", "var")]
        wrong = [value.isnan().any(-1) for value in made if value is not None and not value.is_cuda]
        if not wrong or not flag_value(torch.stack([each.any() for each in wrong]).any()):
            return
        nan = torch.stack(wrong).any(0)
        first = nan.nonzero()[nan.nonzero()[:, -1].argmin()].tolist()
        *row, time = first
        entries = {k: v[tuple(first)].detach() for k, v in record.entries.items() if v.shape[:dims] == nan.shape}
        written = {k: v[tuple(first)].detach() for k, v in record.written.items() if v.shape[:dims] == nan.shape}
        before = (*row, time - 1)
        for key in structure.carry if time else ():
            if key in record.written:
                entries[key] = record.written[key][before].detach()
        for key in structure.controls:
            if previous_key(key) in entries:
                entries[key] = entries[previous_key(key)]
            elif time and key in record.entries:
                entries[key] = record.entries[key][before].detach()
        why = bad_inputs(structure, entries, written) or reason(structure, entries, written)
        text = f"The belief is NaN from row {first} of the sequence on, because of {why}. {cure_of(why)}"
        if "no covariance" in why:
            raise ValueError(text)
        self.warn(f"NaN because of {why}", f"{text}RejectReadings in front of the filter makes such a reading missing.")


def _found(record: Record, key: NestedKey) -> Tensor | None:
    """Returns an entry that a run wrote, or read."""
    return record.written.get(key, record.entries.get(key))
