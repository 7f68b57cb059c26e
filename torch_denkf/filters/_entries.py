"""From tensordicts to entries, which are a flat dictionary of tensors, and back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf.modules._call import Entries

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["of_one_robot", "own", "write"]


def of_one_robot(filter: Filter, tensordict: TensorDictBase | Mapping[str, Any]) -> TensorDictBase:
    """A tensordict as it is; of a dictionary a new one, ``[]``, in the filter's precision and on its device."""
    if isinstance(tensordict, TensorDictBase):
        return tensordict
    if not isinstance(tensordict, Mapping):
        raise TypeError(
            f"{type(filter).__name__} takes a tensordict, or a dictionary of numbers, arrays or tensors; got "
            f"{type(tensordict).__name__}"
        )
    like = filter.like()
    out = TensorDict(dict(tensordict), batch_size=[])
    out = out.apply(lambda value: value.reshape(1) if value.ndim == 0 else value)  # a number is an entry of one
    if like is None:
        return out
    return out.apply(lambda value: value.to(like.device, like.dtype if value.is_floating_point() else None))


def own(written: Entries, given: Iterable[Tensor] = ()) -> Entries:
    """The entries, each in memory of its own: no views, of a filter's constants for example, nothing that was given.

    Args:
        written: what modules wrote.
        given: tensors that the caller keeps.
    """
    if torch.compiler.is_compiling():  # what a graph returns is its own
        return written
    seen, out = {id(value) for value in given}, {}
    for key, value in written.items():
        out[key] = value.clone() if value._is_view() or id(value) in seen else value
        seen.add(id(value))
    return out


def write(filter: Filter, tensordict: TensorDictBase, written: Entries) -> None:
    """Sets entries, looking up each nested tensordict once."""
    owners: dict[tuple, Any] = {}
    for key, value in written.items():
        if filter.prefix is not None:
            key = filter.outer(key)
        prefix = () if isinstance(key, str) else key[:-1]
        owner = tensordict if not prefix else owners.get(prefix)
        if owner is None:
            owner = tensordict.get(prefix, None) if type(tensordict) is TensorDict else None
        if isinstance(owner, TensorDictBase):
            owners[prefix] = owner
            owner.set(key[-1] if prefix else key, value)
        else:  # not there yet
            tensordict.set(key, value)
