"""Targets of the fuzz suite: arguments, entries and files, with their damage."""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import SECONDS, Case
from benchmarks.reliability.documents import FORMATS, Place, edited, places
from torch_denkf._arguments import _signature

Right = Callable[[Any], bool] | None  # whether a result is right; ``None`` if the case must raise


@dataclass(frozen=True)
class Target:
    """An argument, entry or file with its wrong values.

    Args:
        border: interface of the library.
        name: of the target; unique in its border.
        words: arguments, keys or files: a clear message has one of them as a word.
        act: uses a wrong value as a user would, in an empty folder.
        wrong: its wrong values.
        right: whether a result is right, judged by the undamaged part of the input; ``None`` if the case must raise.
        rights: ``right`` for some of the values, by their names; or a function of name and value that returns it.
        within: time limit in s.
        needs: makes the undamaged input in a separate process; called once.
        slow: whether ``needs`` takes so long that small samples skip the target.
        said: whether a text value also counts as one of ``words``.
    """

    border: str
    name: str
    words: tuple[str, ...]
    act: Callable[[Any, Path], Any]
    wrong: d.Wrong
    right: Right = None
    rights: Mapping[str, Right] | Callable[[str, Any], Right] = field(default_factory=dict)
    within: float = SECONDS
    needs: Callable[[], Any] | None = None
    slow: bool = False
    said: bool = False

    def case(self, one: tuple[str, Any]) -> Case:
        """Returns the case of one wrong value."""
        what, value = one
        rights = self.rights
        right = rights(what, value) if callable(rights) else rights.get(what, self.right)
        name = f"{self.name}: {what}"
        words = (*self.words, value) if self.said and isinstance(value, str) and value else self.words
        return Case(self.border, name, words, lambda folder: self.act(value, folder), right, self.within)

    def matching(self, part: str) -> Target:
        """Returns the target with the named cases that have ``part`` in their names, or all if its own name has it."""
        if part in f"{self.border} {self.name}:":
            return self
        named = {
            what: value for what, value in self.wrong.named.items() if part in f"{self.border} {self.name}: {what}"
        }
        return replace(self, wrong=d.Wrong(named, self.wrong.others))

    def named(self) -> list[Case]:
        """Returns the named cases."""
        return [self.case(one) for one in self.wrong.named.items()]

    def some(self) -> st.SearchStrategy[Case]:
        """Draws any case."""
        return self.wrong.some().map(self.case)

    def others(self) -> st.SearchStrategy[Case]:
        """Draws a case that is not a named one."""
        return self.wrong.others.map(self.case)


@dataclass(frozen=True)
class Source:
    """A valid input, a folder or entries, and its reader; damage is applied to a copy.

    Args:
        border: of its targets.
        sound: makes the valid input.
        read: reads it.
        name: prefix of its targets' names.
    """

    border: str
    sound: Callable[[], Any]
    read: Callable[..., Any]
    name: str = ""

    def damaged(self, change: d.Change, folder: Path | None = None, file: str = "", **options: Any) -> Any:
        """Returns the result of reading a damaged copy.

        Args:
            change: of entries, or of a file; entries are replaced by its return value, if that is not ``None``.
            folder: for the copy; by default one in the working folder.
            file: the damaged file in the folder, by default the folder itself.
            **options: of the reader.
        """
        whole = self.sound()
        if isinstance(whole, Path):
            whole = d.copied(whole, folder or Path(tempfile.mkdtemp(dir=".")))
            change(whole / file)
            return self.read(whole, **options)
        whole = whole.copy()
        changed = change(whole)
        return self.read(whole if changed is None else changed, **options)

    def reference(self, **options: Any) -> Any:
        """Returns the cached result of reading the undamaged input."""
        return _reference(self, tuple(options.items()))

    def like(self, change: d.Change | None = None, near: float = 0.0, **options: Any) -> Callable[[Any], bool]:
        """Returns a check for the result of another change, by default of none; NaN never passes."""

        def right(result: Any) -> bool:
            expected = self.damaged(change, **options) if change else self.reference(**options)
            return d.same(result, expected, rtol=near, atol=near)

        return right

    def target(
        self,
        name: str,
        wrong: d.Wrong | Mapping[str, d.Change] | d.Change,
        right: Right = None,
        words: str | tuple[str, ...] = (),
        file: str = "",
        options: Mapping[str, Any] | None = None,
        **more: Any,
    ) -> Target:
        """Returns a target whose wrong values are changes of the input, or of a file in it."""
        words = (words,) if isinstance(words, str) else words
        wrong = {"damaged": wrong} if callable(wrong) else wrong
        wrong = wrong if isinstance(wrong, d.Wrong) else d.Wrong(wrong)
        act = lambda change, folder: self.damaged(change, folder, file, **(options or {}))  # noqa: E731
        more = {"needs": self.sound, **more}
        return Target(self.border, f"{self.name}{name}", words or (Path(file).name,), act, wrong, right, **more)

    def document(
        self,
        file: str,
        right: Right = None,
        words: tuple[str, ...] = (),
        *,
        skip: Callable[[Place], bool] = lambda place: False,
        loose: Callable[[Place], bool] = lambda place: True,
        then: Callable[[d.Change], d.Change] = lambda change: change,
        but: tuple[str, ...] = (),
        **more: Any,
    ) -> Iterator[Target]:
        """Yields a target for each place of a document.

        Args:
            file: the document.
            right: whether a result is right, in a loose place.
            words: of clear messages, in addition to the names of the file and the place.
            skip: whether to skip a place.
            loose: whether a wrong value in a place may give a result without an error.
            then: wraps a change of the file, for example to adapt a checksum.
            but: names of values that may be valid.
            **more: of the targets.
        """
        form, root = FORMATS[Path(file).suffix], self.sound()
        for place, leaf in places(form.load(root / file)):
            if not skip(place):
                wrong = form.wrong(place, leaf).without(*but)
                changes = wrong.each(lambda value, at=place: then(edited(d.put(at, value))))
                named, judge = tuple(map(str, place)), right if loose(place) else None
                said = (Path(file).name, *named, *words)
                yield self.target(f"{root.name}/{file}, {'/'.join(named)}", changes, judge, said, file, **more)

    def arguments(self, name: str, **more: Any) -> Subject:
        """Returns the reader's arguments as a subject with this name."""
        return Subject(lambda **given: self.read(self.sound(), **given), name=name, **more)


@cache
def _reference(source: Source, options: tuple[tuple[str, Any], ...]) -> Any:
    whole = source.sound()
    return source.read(whole if isinstance(whole, Path) else whole.copy(), **dict(options))


#: Wrong values of arguments, by their annotation.
OF_KINDS: dict[str, d.Wrong] = {
    "NestedKey": d.Wrong(
        {"a number": 5, "empty": "", "an empty tuple": (), "numbers": ("info", 3), "a list": ["info"]}
    ),
    "Sequence[NestedKey]": d.Wrong({"one key": "action", "a number": 5, "numbers": [1, 2]}),
    "bool": d.Wrong({"text": "yes", "a number": 2, "nothing": None}),
    "Callable": d.Wrong({"a number": 3, "text": "sine"}),
    "torch.Generator": d.Wrong({"a seed": 3, "text": "cpu"}),
}
#: Wrong values of arguments by name, for names with the same meaning everywhere.
OF_NAMES: dict[str, d.Wrong] = {
    **dict.fromkeys(("transition", "observation", "noise", "initial", "network", "velocity", "modules"), d.MODULE),
    **dict.fromkeys(("hidden_size", "num_layers", "lags", "longest", "in_features", "out_features"), d.COUNT),
    **dict.fromkeys(("observation_dim", "state_dim", "encoding_dim", "dim", "keypoints", "iterations"), d.COUNT),
    **dict.fromkeys(("in_channels", "pooled", "trunk_memory", "tile", "sensor_updates", "features"), d.COUNT),
    **dict.fromkeys(("inflation", "epsilon", "prior_std", "tempering", "height", "focal", "reach"), d.POSITIVE),
    **dict.fromkeys(("ess_threshold", "relaxation", "p"), d.SHARE),
    **dict.fromkeys(("posterior_std", "floor", "factor"), d.NOT_NEGATIVE),
    **dict.fromkeys(("resampling", "layer", "scheme", "score", "reduction"), d.CHOICE),
    "variance_ceiling": d.POSITIVE.but("inf"),
    "process_noise": d.vector(2, negative=False),
    "mean": d.vector(2),
    "loc": d.vector(2),
    "scale": d.vector(2, positive=True).but("inf"),  # an infinite scale removes an input
    "std": d.vector(2, negative=False, length=False) | {"too long": [1.0] * 3},
    "ensemble_size": d.LARGE_COUNT,
    "dt": d.POSITIVE.but("text", "zero"),  # text is a key
    "rate": d.RATE,
    "num_cells": d.CELLS,
    "size": d.SIZE,
}


def annotations(make: Callable[..., Any]) -> dict[str, str]:
    """Returns the arguments of a class or function with their annotations as text."""
    if isinstance(make, type):
        signature, options, _ = _signature(make)
    else:
        signature, options = inspect.signature(make), {}
    return {name: str(one.annotation) for name, one in signature.parameters.items()} | options


@dataclass(frozen=True)
class Subject:
    """A class or function with arguments.

    Args:
        make: the class or function.
        sound: returns valid arguments by name.
        use: uses the result as a user would, to find mistakes that the constructor cannot detect.
        wrong: wrong values of arguments, in addition to those by name and annotation; ``None`` for none.
        also: other words by which a message may name an argument.
        right: for some arguments, whether a result is the documented one for a wrong value.
        name: for the record.
    """

    make: Callable[..., Any]
    sound: Callable[[], dict[str, Any]] = dict
    use: Callable[[Any], Any] = field(default=lambda made: made)
    wrong: Mapping[str, d.Wrong | None] = field(default_factory=dict)
    also: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    right: Mapping[str, Callable[[Any], bool]] = field(default_factory=dict)
    name: str = ""

    def damage(self) -> dict[str, d.Wrong]:
        """Returns the wrong values of each argument."""
        found = {}
        for name, text in annotations(self.make).items():
            kind = text.removesuffix(" | None").split("[...")[0]
            values = OF_NAMES.get(name) or (OF_KINDS.get(kind) if isinstance(self.make, type) else None)
            if values is not None:
                optional = "None" in text and "nothing" in values.named
                found[name] = values.but("nothing") if optional else values
        return {name: values for name, values in {**found, **self.wrong}.items() if values is not None}

    def targets(self, border: str, **more: Any) -> Iterator[Target]:
        """Yields a target for every argument."""
        name = self.name or self.make.__qualname__
        for argument, wrong in self.damage().items():
            words = (argument, *self.also.get(argument, ()))
            act = lambda value, folder, argument=argument: self.act(argument, value)  # noqa: E731
            yield Target(border, f"{name}({argument})", words, act, wrong, self.right.get(argument), **more)

    def act(self, argument: str, value: Any) -> Any:
        """Calls ``make`` with a wrong value, and uses the result."""
        return self.use(self.make(**{**self.sound(), argument: value}))


def targets_of(border: str, *subjects: Subject, **more: Any) -> Iterator[Target]:
    """Yields the targets of several subjects."""
    for subject in subjects:
        yield from subject.targets(border, **more)
