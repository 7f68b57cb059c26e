"""Raises if an observation has dimensions that neither the batch nor an ensemble has."""

from __future__ import annotations

from collections.abc import Iterator

from tensordict import NestedKey, unravel_key
from torch import Tensor

from torch_denkf.beliefs import Ensemble, Particles, is_samples
from torch_denkf.diagnosis.once import Once
from torch_denkf.filters.base import Filter
from torch_denkf.filters.finish import Record
from torch_denkf.filters.structure import Structure
from torch_denkf.submodel import Update, in_role

__all__ = ["ReadingRanks"]


class ReadingRanks(Once):
    """Raises if an observation of several robots would be broadcast against the belief of one."""

    def __init__(self) -> None:
        super().__init__()
        self._known: tuple[Structure | None, list[NestedKey]] = (None, [])

    def __call__(self, filter: Filter, record: Record) -> None:
        """Looks at the dimensions of the observations that a filter read.

        Raises:
            ValueError: that names the observation and its shape.
        """
        structure, size = filter.structure, record.batch_size
        if self._known[0] is not structure:
            self._known = structure, list(_read_as_they_are(structure))
        for key in self._known[1]:
            value = record.entries.get(key)
            if value is not None and value.ndim > len(size) + 1:
                self._check(structure, record, key, value)

    def _check(self, structure: Structure, record: Record, key: NestedKey, value: Tensor) -> None:
        members, size = None, record.batch_size
        for kind in structure.kinds:
            points = record.entries.get(kind.carry[0]) if isinstance(kind, Ensemble | Particles) else None
            members = members if points is None else points.shape[-2]
        extra = value.ndim - len(size) - 1 - (is_samples(key) or value.shape[-2:-1] == (members,))
        if extra > 0:
            raise ValueError(
                f"The reading {key!r} is {list(value.shape)}, and the batch is {list(size)}: {extra} dimension(s) too "
                "many. Readings of several robots need a belief for each: filter a tensordict whose batch holds the "
                "robots, such as tensordict['agents'] of a group. Readings of one robot: put them side by side, with "
                "flatten(-2). Samples of one reading: under a key whose last name is 'ensemble'."
            )


def _read_as_they_are(structure: Structure) -> Iterator[NestedKey]:
    """Yields the observations that come from outside and no sensor changes; their noise may be a matrix."""
    for _, module in structure.update:
        for part in in_role(module, Update):
            yield from (key for key in map(unravel_key, part.reading_keys[:1]) if key in structure.needed)
