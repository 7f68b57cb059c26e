"""A constructor or function with sound arguments, and the damage that each of them can take."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.reliability.case import Case

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


def cases_of(border: str, subjects: Sequence[Subject]) -> Iterator[Case]:
    """A case for every wrong value of every argument."""
    for subject in subjects:
        for argument, values in subject.damage.items():
            words = (argument, *subject.also.get(argument, ()))
            for what, value in values.items():
                act, right = partial(_act, subject, argument, value), subject.right.get(argument)
                yield Case(border, f"{subject.name}({argument}: {what})", words, act, right)


def _act(subject: Subject, argument: str, value: Any, folder: Path) -> Any:
    return subject.use(subject.make(**{**subject.sound(), argument: value}))
