"""What a sub-model needs of a tensordict, and no more: the entries of one step in a dictionary.

Every read and write of a TensorDict costs 1 to 3 us of checks, forty times a step; a step of small networks takes
200 us. Inside a filter, sub-models that only read and write tensors run on a :class:`Row` instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from torch_denkf.modules._base import SubModel

__all__ = ["Row", "RowPlan", "on_rows"]


class Row:
    """Entries by unravelled key, with the few methods of a TensorDict that sub-models use.

    Args:
        entries: tensors (or noise that is a TensorDict) by unravelled key.
        batch_size: ``[*B]`` of the step.
        device: the tensordict's, ``None`` where it has none.
        source: the tensordict that the entries are from, for messages.

    Example:
        >>> row = Row({("belief", "mean"): torch.zeros(3, 2)}, torch.Size([3]))
        >>> row.set("speed", torch.ones(3, 1)).get("speed").shape, row.get("observed"), row.ndim
        (torch.Size([3, 1]), None, 1)
    """

    def __init__(
        self,
        entries: dict[NestedKey, Any],
        batch_size: Sequence[int],
        device: torch.device | None = None,
        source: TensorDictBase | None = None,
    ):
        self.entries, self.batch_size, self.device, self.source = entries, batch_size, device, source

    @classmethod
    def of(cls, tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> Row:
        """The entries ``keys`` of a tensordict, as far as it has them."""
        entries = {}
        for key in keys:
            value = tensordict.get(key, None)
            if value is not None:
                entries[key] = value
        return cls(entries, tensordict.batch_size, tensordict.device, tensordict)

    def write(self, tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> TensorDictBase:
        """Sets the entries ``keys`` in a tensordict, which checks only what does not fit at first sight."""
        size, device, entries = self.batch_size, self.device, self.entries
        ndim, owners = len(size), {}
        for key in keys:
            value = entries[key]
            fits = (
                isinstance(value, Tensor) and value.shape[:ndim] == size and (device is None or device == value.device)
            )
            path, name = ((), key) if isinstance(key, str) else (key[:-1], key[-1])
            owner = owners.get(path)
            if owner is None:
                owner = owners[path] = tensordict.get(path, None) if path else tensordict
            if type(owner) is TensorDict:
                owner._set_str(name, value, inplace=False, validated=fits)
            else:  # not there yet, or something else
                del owners[path]
                tensordict._set_tuple((*path, name), value, inplace=False, validated=fits)
        return tensordict

    @property
    def ndim(self) -> int:
        """Number of batch dimensions."""
        return len(self.batch_size)

    def get(self, key: NestedKey, default: Any = None) -> Any:
        """The entry, or ``default``."""
        return self.entries.get(key, default)

    def set(self, key: NestedKey, value: Any) -> Row:
        """Writes an entry."""
        self.entries[key] = value
        return self

    def update(self, entries: Row | Mapping[NestedKey, Any]) -> Row:
        """Writes several entries."""
        self.entries.update(entries.entries if isinstance(entries, Row) else entries)
        return self

    def select(self, *keys: NestedKey) -> Row:
        """A row of some of the entries."""
        return Row({key: self.entries[key] for key in keys}, self.batch_size, self.device)

    def copy(self) -> Row:
        """Another row of the same entries."""
        return Row(dict(self.entries), self.batch_size, self.device, self.source)

    def expand(self, *shape: int) -> Row:
        """A row of the entries, each ``[*shape, ...]`` in place of ``[*B, ...]``."""
        entries = {key: value.expand(*shape, *value.shape[self.ndim :]) for key, value in self.entries.items()}
        return Row(entries, torch.Size(shape), self.device)

    def detach(self) -> Row:
        """A row of the entries without their history."""
        entries = {key: value.detach() for key, value in self.entries.items()}
        return Row(entries, self.batch_size, self.device)

    def keys(self, include_nested: bool = True, leaves_only: bool = True) -> list[NestedKey]:
        """All names, also those of the source."""
        names = [] if self.source is None else list(self.source.keys(include_nested, leaves_only))
        return list(dict.fromkeys([*names, *self.entries]))


class RowPlan(NamedTuple):
    """What a step on rows needs to know.

    Attributes:
        given: the modules it was made for.
        modules: the sub-models to run, in order; sequences among ``given`` are opened.
        reads: entries that they may read before they write them.
        writes: entries that they write.
        parts: all sub-models, also those inside others, outer ones first: the order in which they draw noise.
    """

    given: tuple[TensorDictModuleBase, ...]
    modules: tuple[SubModel, ...]
    reads: list[NestedKey]
    writes: list[NestedKey]
    parts: tuple[SubModel, ...]


def on_rows(modules: Iterable[TensorDictModuleBase], known: RowPlan | None = None) -> RowPlan | None:
    """A plan to run all modules on a :class:`Row` if they can; otherwise ``None``.

    A sub-model can if the class that defines its ``forward`` says ``runs_on_rows = True``, so a sub-class with its own
    ``forward`` gets a TensorDict unless it says so, too; if all modules of tensordicts inside it can; and if nobody has
    hooked into it.

    Args:
        modules: in order.
        known: an earlier plan, returned again if it is for the same modules.
    """
    if torch.compiler.is_dynamo_compiling():  # who compiles a filter from outside gets what a TensorDict does
        return None
    given = tuple(modules)
    if known is None or known.given != given or known.given != known.modules:
        flat = _opened(given)
        if not all(map(_runs_on_rows, flat)):
            return None
        reads: dict[NestedKey, None] = {}
        writes: dict[NestedKey, None] = {}
        parts: list[SubModel] = []
        for module in flat:
            inner = [part for part in module.modules() if isinstance(part, SubModel)]
            for part in inner:
                keys = (*part.in_keys, *part.optional_keys, part.noise_key)
                reads.update(dict.fromkeys(key for key in keys if key is not None and key not in writes))
            parts += inner
            writes.update(dict.fromkeys(module.out_keys))
        known = RowPlan(given, tuple(flat), list(reads), list(writes), tuple(parts))
    for part in known.parts:
        if part._forward_hooks or part._forward_pre_hooks:
            return None
    return known


def _opened(modules: Iterable[TensorDictModuleBase]) -> list[TensorDictModuleBase]:
    """The modules, with plain sequences among them opened."""
    flat = []
    for module in modules:
        plain = type(module) is TensorDictSequential and not module._forward_hooks and not module._forward_pre_hooks
        flat += _opened(module.module.children()) if plain else [module]
    return flat


def _runs_on_rows(module: TensorDictModuleBase) -> bool:
    if not isinstance(module, SubModel):
        return False
    for part in module.modules():
        if isinstance(part, TensorDictModuleBase):
            owner = next(kind for kind in type(part).__mro__ if "forward" in vars(kind))
            if not isinstance(part, SubModel) or not vars(owner).get("runs_on_rows", False):
                return False
    return True
