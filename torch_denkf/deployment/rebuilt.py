"""Checks that a builder function makes the model that is saved with its settings.

Parameters and buffers are loaded from the file. Other attributes are not: the number of members, an analysis' scheme,
the keys, a function between two layers. These are compared, without running the model.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import nn

__all__ = ["build_from", "check_rebuilt", "differences"]

#: Attributes of a model's execution, which are not compared.
_OF_A_RUN = ("training", "compiled")
_PLAIN = (type(None), bool, int, float, str, bytes, torch.dtype, torch.device, torch.Size)


def build_from(builder: Callable[..., nn.Module], settings: Mapping[str, Any]) -> nn.Module:
    """Calls a builder with settings from JSON, in which lists become tuples."""
    return builder(**{name: _as_tuples(value) for name, value in settings.items()})


def check_rebuilt(model: nn.Module, name: str, builder: Callable[..., nn.Module], settings: Mapping[str, Any]) -> None:
    """Raises a ``ValueError`` if a builder makes another model; the message names the differences."""
    with torch.random.fork_rng(devices=[]):
        built = build_from(builder, settings)
    for label in ("builder", "settings"):  # loaded models have these attributes
        if hasattr(model, label) and not hasattr(built, label):
            setattr(built, label, getattr(model, label))
    found = sorted(differences(model, built))
    if found:
        listed = "; ".join(found[:5]) + (f"; and {len(found) - 5} more" if len(found) > 5 else "")
        given = ", ".join(f"{key}={value!r}" for key, value in settings.items())
        raise ValueError(
            f"{name}({given}) builds another model than the one to be stored, and would build it again when that is "
            f"read: {listed}. Pass the settings that this model was built with; what was changed afterwards must be "
            "one of them."
        )


def differences(given: nn.Module, built: nn.Module) -> Iterator[str]:
    """Lists the differences of two models, except in values of parameters and stored buffers.

    It compares the modules and their types; names, shapes and dtypes of stored tensors; buffers that are not stored;
    and public attributes with plain values, tensors, functions, or containers of these.

    Args:
        given: one model.
        built: the other one.

    Yields:
        A phrase for each difference, such as ``"initial.ensemble_size is 8, built: 32"``.

    Example:
        >>> list(differences(nn.Dropout(0.5), nn.Dropout(0.1)))
        ['p is 0.5, built: 0.1']
        >>> list(differences(nn.Linear(2, 1), nn.Linear(3, 1)))
        ['in_features is 2, built: 3', 'weight is torch.float32 [1, 2], built: torch.float32 [1, 3]']
    """
    theirs = dict(built.named_modules())
    for path, module in given.named_modules():
        other = theirs.pop(path, None)
        if type(other) is not type(module):
            yield f"{path or 'the model'} is {_name(module)}, built: {_name(other)}"
            continue
        ours, others = _attributes(module), _attributes(other)
        for name in ours.keys() | others.keys():
            if not _same(ours.get(name), others.get(name)):
                where = f"{path}.{name}" if path else name
                yield f"{where} is {_short(ours.get(name))}, built: {_short(others.get(name))}"
    yield from (f"{path} is None, built: {_name(module)}" for path, module in theirs.items())
    stored, made = given.state_dict(), built.state_dict()
    for name in {**stored, **made}:
        one, two = (_kind(state.get(name)) for state in (stored, made))
        if one != two:
            yield f"{name} is {one}, built: {two}"
    constants = dict(built.named_buffers())
    for name, value in given.named_buffers():
        if name not in stored and name in constants and not _same(value, constants[name]):
            yield f"{name} is {_short(value)}, built: {_short(constants[name])}"


def _attributes(module: nn.Module) -> dict[str, Any]:
    found = {name: value for name, value in vars(module).items() if name[0] != "_" and name not in _OF_A_RUN}
    return found | {name: getattr(module, name) for name in ("in_keys", "out_keys") if hasattr(module, name)}


def _same(one: Any, other: Any) -> bool:
    """Returns True if two values are equal, or for unknown kinds if their types are equal."""
    if isinstance(one, _PLAIN) or isinstance(other, _PLAIN):
        return type(one) is type(other) and (one == other or one != one)  # NaN equals NaN
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return _kind(one) == _kind(other) and bool(one.cpu().isclose(other.cpu(), rtol=0, atol=0, equal_nan=True).all())
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, Sequence) and isinstance(other, Sequence):  # JSON settings have tuples in place of lists
        return len(one) == len(other) and all(map(_same, one, other))
    if type(one) is not type(other):
        return False
    if is_dataclass(one):
        return all(_same(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    return all(map(_same, _parts(one), _parts(other)))


def _parts(value: Any) -> list[Any]:
    """Lists the code and the values of a function; empty for other objects."""
    if isinstance(value, functools.partial):
        return [value.func, value.args, value.keywords]
    if isinstance(value, types.CodeType):  # ignores line numbers
        return [value.co_code, value.co_names, value.co_consts]
    if isinstance(value, types.FunctionType):
        inside = [cell.cell_contents for cell in value.__closure__ or ()]
        # Networks in a closure are not compared: only modules store their values.
        return [value.__code__, value.__defaults__, [part for part in inside if not isinstance(part, nn.Module)]]
    return []


def _kind(value: Any) -> str:
    return f"{value.dtype} {list(value.shape)}" if isinstance(value, torch.Tensor) else "None"


def _name(module: nn.Module | None) -> str:
    return "None" if module is None else type(module).__name__


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) < 60 else f"{text[:57]}..."


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value
