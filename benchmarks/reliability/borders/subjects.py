"""A constructor or function with sound arguments, and the damage that each of them can take."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.reliability.case import Case
from torch_denkf._arguments import _signature

__all__ = ["Subject", "cases_of"]


@dataclass(frozen=True)
class Subject:
    """Something with arguments.

    Args:
        name: for the record.
        make: the class or function.
        sound: returns right arguments by name.
        damage: for some arguments, wrong values by the name of what is wrong with them.
        use: what a user would do with what was made, where a mistake may show that the constructor cannot see.
        also: other words by which a message may name an argument.
        right: for some arguments, whether a result is one that the documentation promises for a wrong value.
    """

    name: str
    make: Callable[..., Any]
    sound: Callable[[], dict[str, Any]]
    damage: Mapping[str, Mapping[str, Any]]
    use: Callable[[Any], Any] = field(default=lambda made: made)
    also: Mapping[str, Sequence[str]] = field(default_factory=dict)
    right: Mapping[str, Callable[[Any], bool]] = field(default_factory=dict)


#: Wrong values of arguments, by their annotation.
OF_KINDS: dict[str, dict[str, Any]] = {
    "NestedKey": {"a number": 5, "empty": "", "an empty tuple": (), "numbers": ("info", 3), "a list": ["info"]},
    "Sequence[NestedKey]": {"one key": "action", "a number": 5, "numbers": [1, 2]},
    "bool": {"text": "yes", "a number": 2, "nothing": None},
    "Callable": {"a number": 3, "text": "sine"},
    "torch.Generator": {"a seed": 3, "text": "cpu"},
}


def of_kinds(make: Callable[..., Any]) -> dict[str, dict[str, Any]]:
    """The keys, flags and functions that a class takes, and wrong values of each."""
    if not isinstance(make, type):
        return {}
    signature, options, _ = _signature(make)
    annotations = {name: str(one.annotation) for name, one in signature.parameters.items()} | options
    found = {}
    for name, text in annotations.items():
        values = OF_KINDS.get(text.removesuffix(" | None").split("[...")[0], {})
        found[name] = {what: value for what, value in values.items() if value is not None or "None" not in text}
    return found


def cases_of(border: str, subjects: Sequence[Subject]) -> Iterator[Case]:
    """A case for every wrong value of every argument."""
    for subject in subjects:
        for argument, values in {**of_kinds(subject.make), **subject.damage}.items():
            words = (argument, *subject.also.get(argument, ()))
            for what, value in values.items():
                act, right = partial(_act, subject, argument, value), subject.right.get(argument)
                yield Case(border, f"{subject.name}({argument}: {what})", words, act, right)


def _act(subject: Subject, argument: str, value: Any, folder: Path) -> Any:
    return subject.use(subject.make(**{**subject.sound(), argument: value}))
