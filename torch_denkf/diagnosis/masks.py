"""Warns if a module uses observations that an observed mask marks as missing."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import get_close_matches
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.transforms import Compose, TransformedEnv

from torch_denkf.diagnosis.once import Once
from torch_denkf.filters.base import Filter
from torch_denkf.filters.finish import Record
from torch_denkf.filters.structure import Structure
from torch_denkf.running import in_sequences, reads, writes
from torch_denkf.submodel import Update, role

__all__ = ["UnreadMasks"]

#: The mask's name in environments and data sets.
_MASK = "observed"
#: :class:`torch_denkf.data.RecordingReplay` puts it behind a table's name.
_OWN_MASK = "_observed"


class UnreadMasks(Once):
    """Warns once of each observed mask that a module of the filter ignores.

    Such a mask is one that no module reads, one that is spelt otherwise, that of a table whose values are held until
    the next arrives, or one that a transform of the environment writes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._seen: set[tuple] = set()
        self._environments: set[int] = set()
        self._known: tuple[Structure | None, list[Any], list[tuple[NestedKey, NestedKey]]] = (None, [], [])

    def __call__(self, filter: Filter, record: Record) -> None:
        """Looks at the masks in the inputs of a filter."""
        structure, tensordict, name = filter.structure, record.tensordict, type(filter).__name__
        if self._known[0] is not structure:
            self._known = structure, list(_unmasked(structure)), [(key, _own(key)) for key in structure.readings]
        _, unmasked, readings = self._known
        if unmasked:
            self._unread(structure, tensordict, unmasked)
        present = tuple(tensordict.keys())
        if present not in self._seen:
            self._seen.add(present)
            self._misspelt(structure, tensordict, name, present)
        for key, own in readings:
            mask = tensordict.get(own, None)
            if mask is not None:
                self._held(structure, tensordict, key, own, mask, name)
        if record.env is not None and id(record.env) not in self._environments:
            self._environments.add(id(record.env))
            self._of_transforms(structure, record.env, name)

    def _unread(self, structure: Structure, tensordict: TensorDictBase, unmasked: list) -> None:
        """Warns of modules that read no mask.

        A mask is ``"observed"``, or a boolean entry that a sensor or the transition may read. One that a module of the
        update reads is taken to belong to that module's reading.
        """
        read_in_update = {key for _, module in structure.update for keys in reads(module) for key in keys}
        before = (*structure.frames, structure.transition)
        for key in dict.fromkeys([_MASK, *(key for _, module in before for key in reads(module)[1])]):
            mask = None if key in read_in_update else tensordict.get(key, None)
            if mask is None or mask.dtype != torch.bool or bool(mask.all()):
                continue
            for place, module in unmasked:
                if not any(_is_mask(tensordict.get(unravel_key(name), None)) for name in module.in_keys):
                    name = type(module).__name__
                    self.warn(
                        f"{key!r} at {place!r}",
                        f"The mask {key!r} hides readings, and {name} at place {place!r} reads no mask: it uses a "
                        f"hidden reading like any other. Name the mask in {name}, optional_keys=[{key!r}], and heed it "
                        "in compute(). Where its reading is never missing, there is nothing to do.",
                    )

    def _misspelt(self, structure: Structure, tensordict: TensorDictBase, name: str, present: tuple) -> None:
        """Warns of a boolean entry that nothing reads, named nearly like a mask that is read and is not there."""
        read = {*structure.optional, *structure.needed}
        # What is the mask of another entry that is there belongs to that entry.
        others = {f"{key}{_OWN_MASK}" for key in present}
        unread = [key for key in present if key not in read and key not in others]
        for key in structure.optional:
            if isinstance(key, str) and key.endswith(_MASK) and key not in present:
                for other in get_close_matches(key, unread, n=1, cutoff=0.85):
                    if not _is_mask(tensordict.get(other)):
                        continue
                    self.warn(
                        f"{key!r} as {other!r}",
                        f"{name} reads the mask {key!r}, which is not there, and nothing reads {other!r}: each reading "
                        f"counts as observed. If {other!r} is that mask, rename it, or pass observed_key={other!r}.",
                    )

    def _held(
        self,
        structure: Structure,
        tensordict: TensorDictBase,
        key: NestedKey,
        own: NestedKey,
        mask: Tensor,
        name: str,
    ) -> None:
        """Warns if a table's forward-filled value would be used as a new observation.

        Whether the filter's masks hide it, too, is looked at where the filter reads no other mask than ``"observed"``.
        """
        if own in structure.optional or own in structure.needed or mask.dtype != torch.bool:
            return
        used = tensordict.get(_MASK, None) if _MASK in structure.optional else None
        held = ~mask if used is None else ~mask & used.any(-1, keepdim=True)
        if f"{own!r}" not in self.said and bool(held.any()):
            self.warn(
                f"{own!r}",
                f"{key!r} has a mask of its own, {own!r}, which no module of {name} reads: a value that is held until "
                f"the next one arrives counts as a new reading each time. Give observed_key={own!r} to the filter or "
                "its analysis, and to the sensor if there is one.",
            )

    def _of_transforms(self, structure: Structure, env, name: str) -> None:
        """Warns if a transform drops the inputs of the filter, and marks that in a mask the filter does not read."""
        read = {*structure.needed, *structure.optional}
        while isinstance(env, TransformedEnv):
            transforms = env.transform if isinstance(env.transform, Compose) else [env.transform]
            for transform in transforms:
                for key, mask in getattr(transform, "hidden_by", {}).items():
                    if key in read and mask not in read:
                        kind = type(transform).__name__
                        self.warn(
                            f"{mask!r} of {key!r}",
                            f"{kind} marks where {key!r} is missing in {mask!r}, which no module of {name} reads: a "
                            f"missing reading, zero, counts as observed. Give observed_key={mask!r} to the filter or "
                            f"its analysis, and to the sensor if there is one; or leave observed_key= of {kind} at its "
                            "default.",
                        )
            env = env.base_env


def _own(key: NestedKey) -> NestedKey:
    """Returns the name that the mask of a table's column has."""
    return key + _OWN_MASK if isinstance(key, str) else (*key[:-1], key[-1] + _OWN_MASK)


def _unmasked(structure: Structure) -> Iterator[tuple[str, TensorDictModuleBase]]:
    """Yields the modules of the update that take in a reading, but name no optional entry, as a mask would be.

    They say what their reading is, or they write the belief and read an entry that no step makes.
    """
    carry, steps = structure.carry, (structure.transition, *structure.update)
    made = {*carry, *(key for _, module in steps for key in writes(module))}
    for place, module in structure.update:
        for part in in_sequences(module):
            must, may = reads(part)
            updates = not made.issuperset(must) and not set(carry).isdisjoint(writes(part))
            if not may and (updates or role(part, Update).reading_keys):
                yield place, part


def _is_mask(value: object) -> bool:
    return isinstance(value, Tensor) and value.dtype == torch.bool
