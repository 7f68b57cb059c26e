"""Explains errors by inputs, precision and missing entries."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.submodel import EXPLAINED, Entries, SubModel

__all__ = ["entry_of", "explained", "missing_entry"]


def explained(module: SubModel, error: Exception, entries: Entries) -> Exception:
    """Adds a sub-model's inputs and constants to an error's message; leaves other errors unchanged.

    Raises:
        TypeError: if entries and parameters differ in precision, or a mask is not boolean.
    """
    _explain_dtypes(module, error, entries)
    if type(error) not in EXPLAINED:  # it may not be made of a message alone
        return error
    return type(error)(f"{error} {_what_there_was(module, entries)}")


def _what_there_was(module: SubModel, entries: Entries) -> str:
    """Lists inputs and constants, with their shapes."""
    values = {key: entries.get(key) for key in (*module.in_keys, *module.optional_keys)}
    read = [_shown(key, value) for key, value in values.items() if isinstance(value, Tensor)]
    named = (*module.named_buffers(recurse=False), *module.named_parameters(recurse=False))
    own = [f"{name} {list(value.shape)}" for name, value in named]
    text = f"({type(module).__name__} read {', '.join(read) or 'nothing'}"
    return f"{text}; its constants are {', '.join(own)})" if own else f"{text})"


def _explain_dtypes(module: SubModel, error: Exception, entries: Entries) -> None:
    if "bool" in str(error):
        for key in module.optional_keys:  # masks, and counts of steps
            mask = entries.get(key)
            if mask is not None and mask.dtype not in (torch.bool, torch.int64):
                raise TypeError(
                    f"{type(module).__name__} reads the mask {key!r}, which must be boolean, True where observed; "
                    f"got {mask.dtype}. Convert it with .bool()."
                ) from error
    own = {p.dtype for p in (*module.parameters(), *module.buffers()) if p.is_floating_point()}
    values = {key: entries.get(key) for key in (*module.in_keys, *module.optional_keys)}
    given = {key: v.dtype for key, v in values.items() if v is not None and v.is_floating_point()}
    if len(own | set(given.values())) > 1 and any(word in str(error) for word in ("dtype", "scalar type")):
        raise TypeError(
            f"{type(module).__name__} computes in {', '.join(map(str, own)) or 'what it is given'} and got "
            + ", ".join(f"{key!r} in {dtype}" for key, dtype in given.items())
            + ". Convert the data (torchrl's DoubleToFloat(), or tensordict.float()) or the filter "
            "(filter.double())."
        ) from error


def _shown(key: NestedKey, value: Tensor) -> str:
    return f"{key!r} {list(value.shape)} {str(value.dtype).removeprefix('torch.')}"


def missing_entry(reader: str, missing: Iterable[NestedKey], present: Iterable[NestedKey], cure: str = "") -> KeyError:
    """Returns the error for entries that are read and missing: names reader, missing and given entries, and a cure.

    Example:
        >>> print(missing_entry("Blur", ["pixels"], ["image", "action"], "Set in_keys=."))
        "Blur reads 'pixels', which is missing. There is action, image. Set in_keys=."
    """
    there = ", ".join(sorted(map(str, present))) or "nothing"
    cure = cure or (
        "Give the filter it (does the environment or the data have it?), put the module that writes it in front, or "
        f"rename the key in the constructor of {reader}."
    )
    return KeyError(f"{reader} reads {', '.join(map(repr, missing))}, which is missing. There is {there}. {cure}")


def entry_of(tensordict: TensorDictBase, key: NestedKey, reader: str, cure: str = "") -> Tensor:
    """Returns an entry of a tensordict.

    Raises:
        KeyError: that is :func:`missing_entry`, if it is missing.
    """
    value = tensordict.get(key, None)
    if value is None:
        raise missing_entry(reader, [key], tensordict.keys(True, True), cure)
    return value
