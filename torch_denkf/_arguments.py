"""Checks constructor arguments by their annotations: names, keys, flags and functions."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

import torch

__all__ = ["Checked", "check_arguments", "check_key"]


class Checked:
    """A class whose constructor checks its arguments by their annotations.

    An argument that is annotated as a key, a list of keys, a flag or a function must be one; an unknown argument is an
    error. Numbers and tensors are checked by the constructors, which know their limits.

    Example:
        >>> class Reader(Checked):
        ...     def __init__(self, *, observed_key: NestedKey = "observed", strict: bool = True): ...
        >>> Reader(observed_key=5)
        Traceback (most recent call last):
        ...
        TypeError: observed_key of Reader is a key, a string or a tuple of strings; got 5
        >>> Reader(observd_key="seen")
        Traceback (most recent call last):
        ...
        TypeError: Reader takes no argument 'observd_key'; it takes observed_key, strict
    """

    def __new__(cls, *args: Any, **kwargs: Any):
        """Checks the arguments of the class that was called, once."""
        check_arguments(cls, args, kwargs)
        new = super().__new__
        return new(cls) if new is object.__new__ else new(cls, *args, **kwargs)


def check_arguments(owner: type, args: tuple, kwargs: Mapping[str, Any]) -> None:
    """Raises unless a class can be called with these arguments.

    Raises:
        TypeError: names the class, the argument, and the expected kind of value.
    """
    signature, options, open_ended = _signature(owner)
    unknown = [name for name in kwargs if name not in signature.parameters and name not in options]
    if unknown and not open_ended:
        names = [name for name, parameter in signature.parameters.items() if parameter.kind not in _VARIABLE]
        raise TypeError(f"{owner.__name__} takes no argument {unknown[0]!r}; it takes {', '.join([*names, *options])}")
    try:
        bound = signature.bind_partial(*args, **kwargs).arguments
    except TypeError:  # Python's own message names the class
        return
    for name, value in bound.items():
        parameter = signature.parameters[name]
        if parameter.kind not in _VARIABLE:
            _check(owner.__name__, name, value, str(parameter.annotation))
        elif parameter.kind is parameter.VAR_KEYWORD:
            for key, one in value.items():
                _check(owner.__name__, key, one, options.get(key, ""))


def check_key(name: str, key: Any) -> None:
    """Raises unless ``key`` names an entry of a tensordict: a string, or a tuple of them, not empty.

    Raises:
        TypeError: names the argument.
    """
    if not _is_key(key):
        raise TypeError(f"{name} is a key, a string or a tuple of strings; got {key!r}")


_VARIABLE = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


@cache
def _signature(owner: type) -> tuple[inspect.Signature, dict[str, str], bool]:
    """Returns the signature without ``self``, the names in ``**options``, and whether other names are allowed."""
    function = inspect.unwrap(getattr(owner, "__init__"))  # noqa: B009  # mypy distrusts it on a type
    signature = inspect.signature(function)
    parameters = list(signature.parameters.values())[1:]
    options: dict[str, str] = {}
    open_ended = False
    for parameter in parameters:
        if parameter.kind is parameter.VAR_KEYWORD:
            annotation = str(parameter.annotation)
            name = annotation.removeprefix("Unpack[").removesuffix("]")
            kind = getattr(function, "__globals__", {}).get(name) if name != annotation else None
            open_ended = kind is None
            options = _of_bases(owner) if kind is None else dict(_fields(kind))
    return signature.replace(parameters=parameters), options, open_ended


def _of_bases(owner: type) -> dict[str, str]:
    """Returns the arguments of the next base class, which receives ``**kwargs``, by name."""
    for base in owner.__mro__[1:]:
        if "__init__" in base.__dict__ and Checked in base.__mro__:
            signature, options, _ = _signature(base)
            return {name: str(one.annotation) for name, one in signature.parameters.items()} | options
    return {}


def _fields(kind: type) -> Iterator[tuple[str, str]]:
    """Returns names and annotations of a TypedDict, as text."""
    for name, annotation in kind.__annotations__.items():
        yield name, getattr(annotation, "__forward_arg__", str(annotation))


def _check(owner: str, name: str, value: Any, annotation: str) -> None:
    optional = annotation.endswith(" | None")
    kind = annotation.removesuffix(" | None")
    if (value is None and optional) or (kind not in _KINDS and not kind.startswith("Callable[")):
        return
    fits, words = _KINDS.get(kind, _FUNCTION)
    if kind == "str" and not name.endswith(("_key", "_prefix", "prefix")):
        return
    if not fits(value):
        raise TypeError(f"{name} of {owner} is {words}{', or None' if optional else ''}; got {_shown(value)}")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _is_key(value: Any) -> bool:
    if isinstance(value, tuple):
        return len(value) > 0 and all(_is_key(part) for part in value)
    return isinstance(value, str) and value != ""


def _are_keys(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and all(_is_key(key) for key in value)


_FUNCTION: tuple[Callable[[Any], bool], str] = (callable, "a function")
#: The checks by annotation: a test of the value, and the expected kind in words.
_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "NestedKey": (_is_key, "a key, a string or a tuple of strings"),
    "Sequence[NestedKey]": (_are_keys, "a list of keys, each a string or a tuple of strings"),
    "str": (lambda value: isinstance(value, str) and value != "", "a name, a string"),
    "bool": (lambda value: isinstance(value, bool), "True or False"),
    "Callable": _FUNCTION,
    "torch.Generator": (lambda value: isinstance(value, torch.Generator), "a torch.Generator"),
}
