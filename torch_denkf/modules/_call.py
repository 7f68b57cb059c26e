"""One call of a module: the tensors that it works on, its noise, and where it stands in a filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

__all__ = ["Call", "Entries", "Noise", "flat_noise"]

#: Tensors by unravelled key: what a step of a filter works on.
Entries: TypeAlias = dict[NestedKey, Tensor]
#: The noise of one call of a sub-model: one tensor, several by name, or ``None`` for the deterministic forward.
Noise: TypeAlias = "Tensor | Mapping[str, Tensor] | None"


class Call(NamedTuple):
    """One call of a module on entries.

    Attributes:
        batch_size: ``[*B]``, in front of every entry.
        place: where the module stands in the filter, e.g. ``"transition"``; its noise is ``("noise", place)``.
        sample: whether random modules draw; if not, they run their deterministic forward.
        time: whether the last dimension of ``batch_size`` is time.
        missing: entries that an initial belief must do without.
    """

    batch_size: torch.Size
    place: str = "self"
    sample: bool = True
    time: bool = False
    missing: frozenset[NestedKey] = frozenset()

    def part(self, name: str) -> Call:
        """The call of a part of the module."""
        return self._replace(place=name if self.place == "self" else f"{self.place}.{name}")


def flat_noise(noise: Noise | TensorDictBase, *place: str) -> Entries:
    """Noise as entries ``("noise", *place)``, or ``("noise", *place, name)`` where it is several tensors."""
    if noise is None:
        return {}
    if isinstance(noise, Tensor):
        return {("noise", *place): noise}
    if isinstance(noise, TensorDictBase):
        keys = noise.keys(True, True)
        return {("noise", *place, *((key,) if isinstance(key, str) else key)): noise.get(key) for key in keys}
    return {("noise", *place, name): value for name, value in noise.items()}
