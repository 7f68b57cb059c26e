"""A small vocabulary of damage: wrong values, changed files and entries, each with a name or drawn by hypothesis."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st
from tensordict import TensorDictBase
from torch import Tensor

NAN, INF = math.nan, math.inf
Named = st.SearchStrategy[tuple[str, Any]]


@dataclass(frozen=True)
class Wrong:
    """Wrong values of one thing.

    Args:
        named: those that are always tried, by what is wrong with them.
        others: draws more of them, each with its name.
    """

    named: Mapping[str, Any]
    others: Named = st.nothing()  # noqa: RUF009 - it cannot be changed

    def __or__(self, more: Wrong | Mapping[str, Any]) -> Wrong:
        """With further ones."""
        if isinstance(more, Wrong):
            return Wrong({**self.named, **more.named}, self.others | more.others)
        return Wrong({**self.named, **more}, self.others)

    def but(self, *names: str) -> Wrong:
        """Without those that are not wrong here; none is drawn, as it might be one of them."""
        return Wrong({name: value for name, value in self.named.items() if name not in names})

    def without(self, *names: str) -> Wrong:
        """Without those that are not wrong here; others are drawn."""
        return Wrong({name: value for name, value in self.named.items() if name not in names}, self.others)

    def each(self, change: Callable[[Any], Any]) -> Wrong:
        """With something made of every value."""
        return Wrong(
            {name: change(value) for name, value in self.named.items()},
            self.others.map(lambda other: (other[0], change(other[1]))),
        )

    def some(self) -> Named:
        """Any of them, with its name."""
        return st.sampled_from(sorted(self.named.items(), key=lambda one: one[0])) | self.others


def drawn(values: st.SearchStrategy[Any]) -> Named:
    """Values under their own names."""
    return values.map(lambda value: (_name(value), value))


def of(*values: Any, drawn: st.SearchStrategy[Any] | None = None) -> Wrong:
    """Returns values under their own names."""
    others = st.nothing() if drawn is None else drawn.map(lambda value: (_name(value), value))
    return Wrong({_name(value): value for value in values}, others)


def _name(value: Any) -> str:
    return " ".join(repr(value).split())[:80]


# ------------------------------------------------------------------------------------------------------- numbers

TEXT = {"text": "much"}
BELOW = st.floats(max_value=-1e-30)
NO_COUNT = st.integers(max_value=-1) | st.floats(0.01, 0.99).map(lambda part: 3 + part)

POSITIVE = Wrong({"zero": 0.0, "negative": -1.0, "nan": NAN, "inf": INF, **TEXT}, drawn(BELOW | st.just(-0.0)))
NOT_NEGATIVE = Wrong({"negative": -1.0, "nan": NAN, "inf": INF, **TEXT}, drawn(BELOW))
FINITE = Wrong({"nan": NAN, "inf": INF, **TEXT}, drawn(st.just(-INF)))
SHARE = Wrong(
    {"negative": -0.1, "beyond one": 1.5, "nan": NAN, "inf": INF, **TEXT}, drawn(BELOW | st.floats(min_value=1.001))
)
RATE = SHARE | {"one": 1.0, "too small for eight bits": 0.001}
COUNT = Wrong({"zero": 0, "negative": -3, "fraction": 2.5, **TEXT}, drawn(NO_COUNT))
LARGE_COUNT = COUNT | {"one": 1}
COUNT_OR_NONE = Wrong({"negative": -3, "fraction": 2.5, **TEXT}, drawn(NO_COUNT))
CHOICE = Wrong({"unknown": "sideways", "a number": 3, "empty": ""}, drawn(st.text("xyz?", min_size=1)))
MODULE = Wrong({"nothing": None, "text": "network"}, drawn(st.integers() | st.binary(max_size=4)))
SIZE = Wrong(
    {"zero": (0, 10), "negative": (-4, 10), "one number": (10,), "text": "ab"},
    drawn(st.tuples(st.integers(max_value=0), st.integers(1, 20))),
)
CELLS = Wrong(
    {"zero": (0,), "negative": (-4,), "fraction": (2.5,), "text": "wide"}, drawn(st.tuples(st.just(4), NO_COUNT))
)


def indices(size: int) -> Wrong:
    """Indices of components, none of which fits ``size`` of them."""
    beyond = st.integers(min_value=size, max_value=99) | st.integers(-99, -size - 1)
    named = {"beyond the end": [size], "far before the start": [-size - 1], "fraction": [0.5], "text": ["x"]}
    return Wrong(named, drawn(beyond.map(lambda index: [0, index])))


def dims(size: int) -> Wrong:
    """Returns indices of components that are read: each at most once."""
    return indices(size) | {"twice the same": [0, 0]}


def vector(size: int, *, positive: bool = False, negative: bool = True, length: bool = True) -> Wrong:
    """Vectors that are none of ``size`` finite numbers; ``positive`` where zero is wrong, too."""

    def of(last: float, place: int = -1) -> list[float]:
        out = [1.0] * size
        out[place] = last
        return out

    bad, named = st.sampled_from([NAN, -INF]), {"nan": of(NAN), "inf": of(INF), "text": "much"}
    if length:
        named |= {"too long": [1.0] * (size + 1), "a matrix": torch.ones(size, size + 1)}
    if not negative or positive:
        named["negative"], bad = of(-0.5), bad | BELOW
    if positive:
        named["zero"] = of(0.0)
    return Wrong(named, drawn(st.builds(of, bad, st.integers(0, size - 1))))


def _with(made: Tensor, place: tuple[int, int], value: float) -> Tensor:
    out = made.clone()
    out[place] = value
    return out


def matrix(rows: int, columns: int) -> Wrong:
    """Matrices that are none of ``rows`` by ``columns`` finite numbers."""
    eye = torch.eye(rows, columns)
    places = st.tuples(st.integers(0, rows - 1), st.integers(0, columns - 1))
    return Wrong(
        {
            "nan": _with(eye, (0, -1), NAN),
            "inf": _with(eye, (-1, 0), INF),
            "a row more": torch.eye(rows + 1, columns),
            "a column more": torch.eye(rows, columns + 1),
            "a vector": torch.ones(columns + 1),
            "three dimensions": torch.ones(2, rows, columns),
            "text": "much",
        },
        drawn(st.builds(_with, st.just(eye), places, st.sampled_from([NAN, INF, -INF]))),
    )


def covariance(size: int) -> Wrong:
    """Matrices that are no covariance of ``size`` components."""
    eye = torch.eye(size)
    return matrix(size, size) | {
        "not symmetric": _with(eye, (0, -1), 0.5),
        "negative variance": _with(eye, (-1, -1), -1.0),
        "indefinite": 1.5 * torch.ones(size, size) - eye,
        "zero beside a correlation": 0.1 * torch.ones(size, size) * (1 - eye) + eye * (torch.arange(size) > 0),
    }


# --------------------------------------------------------------------------------------------------------- files

Change = Callable[[Any], Any]


def copied(sound: Path, folder: Path) -> Path:
    """A copy of a folder that a case may damage."""
    target = folder / sound.name
    shutil.copytree(sound, target, symlinks=True)
    return target


def gone(file: Path) -> None:
    """Takes a file or folder away."""
    if file.is_dir():
        shutil.rmtree(file)
    else:
        file.unlink()


def written(change: Callable[[bytes], bytes]) -> Change:
    """Damages a file's bytes."""
    return lambda file: file.write_bytes(change(file.read_bytes()))


def instead(make: Change) -> Change:
    """Puts something else in a file's place."""
    return lambda file: (gone(file), make(file))


def flipped(at: float, mask: int = 0xFF) -> Callable[[bytes], bytes]:
    def flip(data: bytes) -> bytes:
        place = min(int(at * len(data)), len(data) - 1)
        return data[:place] + bytes([data[place] ^ mask]) + data[place + 1 :]

    return flip


def _cut(at: float) -> Callable[[bytes], bytes]:
    return lambda data: data[: int(at * len(data))]


#: What happens to a file's bytes.
BYTES = Wrong(
    {
        "empty": lambda data: b"",
        "cut in half": lambda data: data[: len(data) // 2],
        "cut by a byte": lambda data: data[:-1],
        "zeros": lambda data: bytes(len(data)),
        "zeros behind": lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2),
        "not UTF-8": lambda data: b"\xff\xfe\x80" + data,
        "another format": lambda data: b"GIF89a" + data[6:],
        "a byte flipped at the start": flipped(0.0),
        "a byte flipped in the middle": flipped(0.5),
        "a byte flipped near the end": flipped(0.95),
    },
    st.floats(0.0, 0.99).map(lambda at: (f"a high bit flipped at {at}", flipped(at, 0x80))),
)
#: Damage of files whose format or checksum tells every cut and every bit.
SEALED = Wrong(
    BYTES.named,
    st.floats(0.0, 0.99).map(lambda at: (f"cut at {at}", _cut(at)))
    | st.tuples(st.floats(0.0, 0.99), st.integers(0, 7)).map(
        lambda place: (f"bit {place[1]} flipped at {place[0]}", flipped(place[0], 1 << place[1]))
    ),
)
#: What stands in a file's place.
PLACES = Wrong(
    {
        "taken away": gone,
        "a folder": instead(Path.mkdir),
        "a link to nowhere": instead(lambda file: file.symlink_to("nowhere")),
        "a link to itself": instead(lambda file: file.symlink_to(file.name)),
        "a link to a device": instead(lambda file: file.symlink_to("/dev/zero")),
        "a pipe": instead(os.mkfifo),
    }
)
#: All that happens to a file.
FILE = BYTES.each(written) | PLACES


# ----------------------------------------------------------------------------------------------- what has entries

MISSING = object()


def put(path: tuple[Any, ...], value: Any) -> Change:
    """Puts a value into nested dictionaries, or takes it away; of a function, what it makes of the value."""

    def change(content: Any) -> None:
        for name in path[:-1]:
            content = content[name]
        changed = value(content[path[-1]]) if callable(value) else value
        if changed is MISSING:
            del content[path[-1]]
        else:
            content[path[-1]] = changed

    return change


def fields(wrong: Mapping[Any, Wrong], *, missing: bool = True) -> Wrong:
    """Changes of what has entries: wrong values of some, and without them.

    Args:
        wrong: by key, or by path of keys.
        missing: whether each is also taken away.
    """
    out = Wrong({})
    for key, values in wrong.items():
        path = key if isinstance(key, tuple) else (key,)
        name = "/".join(path)
        values |= {"missing": MISSING} if missing else {}
        changes = values.each(lambda value, path=path: put(path, value))
        out |= Wrong(
            {f"{name} {what}": change for what, change in changes.named.items()},
            changes.others.map(lambda one, name=name: (f"{name} {one[0]}", one[1])),
        )
    return out


# --------------------------------------------------------------------------------------------------- comparisons


def leaves(result: Any) -> dict[str, Tensor]:
    """The tensors of a result, by name."""
    if isinstance(result, Tensor):
        return {"": result}
    if isinstance(result, TensorDictBase):
        return {str(key): result[key] for key in result.keys(True, True) if isinstance(result[key], Tensor)}
    if isinstance(result, list | tuple):
        result = dict(enumerate(result))
    if isinstance(result, dict):
        return {f"{key}{name}": value for key, part in result.items() for name, value in leaves(part).items()}
    raise TypeError(f"{type(result).__name__} holds no tensors")


def finite(result: Any) -> bool:
    """Tells whether all numbers are finite."""
    return all(bool(value.isfinite().all()) for value in leaves(result).values())


def same(result: Any, expected: Any, *, rtol: float = 0.0, atol: float = 0.0) -> bool:
    """Tells whether two results have the same entries, with the same numbers."""
    one, other = leaves(result), leaves(expected)
    return one.keys() == other.keys() and all(
        one[key].shape == other[key].shape
        and torch.allclose(one[key].double(), other[key].double(), rtol=rtol, atol=atol, equal_nan=False)
        for key in one
    )


def kept(result: Any, expected: Any, *, most: int = 1, rtol: float = 0.0) -> bool:
    """Tells whether rows are as expected, but for some that are marked as missing, or lack at the end.

    Args:
        result: entries ``[N, ...]``.
        expected: likewise, maybe longer; its boolean entries are masks, False where a row's reading does not count.
        most: so many rows may be marked.
        rtol: of the comparison.
    """
    one, other = leaves(result), leaves(expected)
    if not other.keys() <= one.keys() or not finite(one):
        return False
    count = len(next(iter(one.values())))
    differ = marked = torch.zeros(count, dtype=torch.bool)
    for key, right in other.items():
        found, right = one[key].reshape(count, -1), right[:count].reshape(min(count, len(right)), -1)
        if found.shape != right.shape:
            return False
        differ = differ | ~found.double().isclose(right.double(), rtol=rtol, atol=rtol).all(-1)
        if found.dtype == torch.bool:
            marked = marked | (right & ~found).any(-1)
    return count > 0 and bool((marked | ~differ).all()) and int(marked.sum()) <= most
