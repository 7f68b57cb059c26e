"""Wrong values, damaged files and damaged entries, each with a name or drawn by hypothesis."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st
from tensordict import TensorDictBase
from torch import Tensor

NAN, INF = math.nan, math.inf
Named = st.SearchStrategy[tuple[str, Any]]
Change = Callable[[Any], Any]


@dataclass(frozen=True)
class Wrong:
    """Wrong values of one argument, entry or file.

    Args:
        named: values that are always tried, by the name of their defect.
        others: strategy that draws further values, each with its name.
    """

    named: Mapping[str, Any]
    others: Named = st.nothing()  # noqa: RUF009 - it cannot be changed

    def __or__(self, more: Wrong | Mapping[str, Any]) -> Wrong:
        """Adds further values."""
        more = more if isinstance(more, Wrong) else Wrong(more)
        return Wrong({**self.named, **more.named}, self.others | more.others)

    def without(self, *names: str) -> Wrong:
        """Removes named values that are valid here; values are still drawn."""
        return replace(self, named={name: value for name, value in self.named.items() if name not in names})

    def but(self, *names: str) -> Wrong:
        """Removes named values that are valid here, and the strategy, which might draw them."""
        return Wrong(self.without(*names).named)

    def each(self, change: Callable[[Any], Any]) -> Wrong:
        """Maps every value."""
        others = self.others.map(lambda other: (other[0], change(other[1])))
        return Wrong({name: change(value) for name, value in self.named.items()}, others)

    def some(self) -> Named:
        """Draws any value, with its name."""
        return st.sampled_from(sorted(self.named.items(), key=lambda one: one[0])) | self.others


def drawn(values: st.SearchStrategy[Any]) -> Named:
    """Draws values, named by their representation."""
    return values.map(lambda value: (_name(value), value))


def of(*values: Any, others: st.SearchStrategy[Any] | None = None) -> Wrong:
    """Returns values, named by their representation."""
    return Wrong({_name(value): value for value in values}, st.nothing() if others is None else drawn(others))


def _name(value: Any) -> str:
    return " ".join(repr(value).split())[:80]


# ------------------------------------------------------------------------------------------------------- numbers

TEXT = {"text": "much"}
BELOW = st.floats(max_value=-1e-30)
NO_COUNT = st.integers(max_value=-1) | st.floats(0.01, 0.99).map(lambda part: 3 + part)

POSITIVE = Wrong({"zero": 0.0, "negative": -1.0, "nan": NAN, "inf": INF, **TEXT}, drawn(BELOW | st.just(-0.0)))
NOT_NEGATIVE = POSITIVE.but("zero") | Wrong({}, drawn(BELOW))
FINITE = Wrong({"nan": NAN, "inf": INF, **TEXT}, drawn(st.just(-INF)))
SHARE = Wrong(
    {"negative": -0.1, "beyond one": 1.5, "nan": NAN, "inf": INF, **TEXT}, drawn(BELOW | st.floats(min_value=1.001))
)
RATE = SHARE | {"one": 1.0, "too small for eight bits": 0.001}
COUNT = Wrong({"zero": 0, "negative": -3, "fraction": 2.5, **TEXT}, drawn(NO_COUNT))
LARGE_COUNT = COUNT | {"one": 1}
COUNT_OR_NONE = COUNT.without("zero")
CHOICE = Wrong({"unknown": "sideways", "a number": 3, "empty": ""}, drawn(st.text("xyz?", min_size=1)))
MODULE = Wrong({"nothing": None, "text": "network"}, drawn(st.integers() | st.binary(max_size=4)))
PAIRS = st.tuples(st.integers(max_value=0), st.integers(1, 20))
SIZE = of((0, 10), (-4, 10), (10,), "ab", others=PAIRS)
CELLS = of((0,), (-4,), (2.5,), "wide", others=st.tuples(st.just(4), NO_COUNT))


def indices(size: int) -> Wrong:
    """Returns invalid indices of ``size`` components."""
    beyond = st.integers(min_value=size, max_value=99) | st.integers(-99, -size - 1)
    return of([size], [-size - 1], [0.5], ["x"], others=beyond.map(lambda index: [0, index]))


def dims(size: int) -> Wrong:
    """Returns invalid indices of observed components, which must also be distinct."""
    return indices(size) | {"twice the same": [0, 0]}


def vector(size: int, *, positive: bool = False, negative: bool = True, length: bool = True) -> Wrong:
    """Returns wrong values of a vector of ``size`` finite numbers; with ``positive``, zero is wrong, too."""

    def of(last: float, place: int = -1) -> list[float]:
        out = [1.0] * size
        out[place] = last
        return out

    bad, named = st.sampled_from([NAN, -INF]), {"nan": of(NAN), "inf": of(INF), "complex": of(1 + 0.5j), **TEXT}
    if length:
        named |= {"too long": [1.0] * (size + 1), "a matrix": torch.ones(size, size + 1)}
    if not negative or positive:
        named["negative"], bad = of(-0.5), bad | BELOW
    if positive:
        named["zero"] = of(0.0)
    return Wrong(named, drawn(st.builds(of, bad, st.integers(0, size - 1))))


# -------------------------------------------------------------------------------------------------------- arrays


def spoiled(place: Any, value: Any) -> Change:
    """Puts a value into a copy of an array or a tensor, at an index or at a fraction of its flattened length."""

    def change(array: Any) -> Any:
        out = array.clone() if isinstance(array, Tensor) else array.copy()
        flat = out.reshape(-1) if isinstance(place, float) else out
        flat[int(place * (len(flat) - 1)) if isinstance(place, float) else place] = value
        return flat.reshape(array.shape)

    return change


def broken(*at: int, places: st.SearchStrategy[tuple[int, ...]]) -> Wrong:
    """Puts NaN and infinity at the index ``at`` of an array, and at random places."""
    others = st.tuples(places | st.just(at), st.sampled_from([NAN, INF, -INF]))
    return Wrong({"a NaN": ((*at, 0), NAN), "inf": ((*at, -1), INF)}, drawn(others)).each(lambda one: spoiled(*one))


MISSING = object()
#: Wrong shapes of an entry ``[..., D]``.
SHAPES = Wrong(
    {
        "missing": MISSING,
        "too wide": lambda value: torch.cat([value, value[..., :1]], -1),
        "too narrow": lambda value: value[..., :-1],
        "without its last dimension": lambda value: value[..., 0],
        "a dimension more": lambda value: value[..., None].expand(*value.shape, 3),
    }
)


def matrix(rows: int, columns: int) -> Wrong:
    """Returns wrong values of a matrix of ``rows`` by ``columns`` finite numbers."""
    eye = torch.eye(rows, columns)
    places = st.tuples(st.integers(0, rows - 1), st.integers(0, columns - 1))
    numbers = broken(0, places=places).each(lambda change: change(eye))
    sizes = {"a row more": (rows + 1, columns), "a column more": (rows, columns + 1), "a vector": (columns + 1,)}
    sizes["three dimensions"] = (2, rows, columns)
    return numbers | {what: torch.ones(size) for what, size in sizes.items()} | {"complex": (1 + 0.5j) * eye, **TEXT}


def covariance(size: int) -> Wrong:
    """Returns wrong values of a covariance of ``size`` components."""
    eye, ones = torch.eye(size), torch.ones(size, size)
    return matrix(size, size) | {
        "not symmetric": spoiled((0, -1), 0.5)(eye),
        "negative variance": spoiled((-1, -1), -1.0)(eye),
        "indefinite": 1.5 * ones - eye,
        "zero beside a correlation": spoiled((0, 0), 0.0)(0.1 * ones + 0.9 * eye),
    }


# --------------------------------------------------------------------------------------------------------- files


def copied(sound: Path, folder: Path) -> Path:
    """Returns a copy of a folder that a case may damage."""
    return Path(shutil.copytree(sound, folder / sound.name, symlinks=True))


def gone(file: Path) -> None:
    """Deletes a file or folder."""
    if file.is_dir():
        shutil.rmtree(file)
    else:
        file.unlink()


def written(change: Callable[[bytes], bytes]) -> Change:
    """Damages a file's bytes."""
    return lambda file: file.write_bytes(change(file.read_bytes()))


def instead(make: Change) -> Change:
    """Replaces a file."""
    return lambda file: (gone(file), make(file))


def renamed(name: str) -> Change:
    """Renames a file."""
    return lambda file: file.rename(file.with_name(name))


def flipped(at: float, mask: int = 0xFF) -> Callable[[bytes], bytes]:
    """Flips bits of the byte at a fraction of the file."""

    def flip(data: bytes) -> bytes:
        place = min(int(at * len(data)), len(data) - 1)
        return data[:place] + bytes([data[place] ^ mask]) + data[place + 1 :]

    return flip


#: Damage to the bytes of a file whose format does not detect flipped bytes.
CUT = Wrong(
    {
        "empty": lambda data: b"",
        "cut in half": lambda data: data[: len(data) // 2],
        "cut by a byte": lambda data: data[:-1],
        "zeros": lambda data: bytes(len(data)),
        "zeros behind": lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2),
        "not UTF-8": lambda data: b"\xff\xfe\x80" + data,
        "another format": lambda data: b"GIF89a" + data[6:],
    }
).each(written)
FLIPPED = Wrong(
    {f"a byte flipped at {at}": flipped(at) for at in (0.0, 0.5, 0.95)},
    st.floats(0.0, 0.99).map(lambda at: (f"a high bit flipped at {at}", flipped(at, 0x80))),
).each(written)
#: Damage to a file's bytes.
BYTES = CUT | FLIPPED
#: Damage to files whose format or checksum detects every cut and every flipped bit.
SEALED = BYTES.but() | Wrong(
    {},
    st.floats(0.0, 0.99).map(lambda at: (f"cut at {at}", written(lambda data: data[: int(at * len(data))])))
    | st.tuples(st.floats(0.0, 0.99), st.integers(0, 7)).map(
        lambda place: (f"bit {place[1]} flipped at {place[0]}", written(flipped(place[0], 1 << place[1])))
    ),
)
#: Replacements of a file.
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
#: Ways in which a file may be missing.
NOTHING = PLACES.but("a folder", "a link to a device", "a pipe")
#: All damage to a file.
FILE = BYTES | PLACES


# ----------------------------------------------------------------------------------------------- what has entries


def put(path: Any, value: Any) -> Change:
    """Sets, maps or deletes a value in nested entries.

    Args:
        path: tuple of keys and indices, or a single one.
        value: the value, a function of the old one, or ``MISSING`` to delete it.
    """
    path = path if isinstance(path, tuple) else (path,)

    def change(content: Any) -> None:
        for name in path[:-1]:
            content = content[name]
        changed = value(content[path[-1]]) if callable(value) else value
        if changed is MISSING:
            del content[path[-1]]
        else:
            content[path[-1]] = changed

    return change


# --------------------------------------------------------------------------------------------------- comparisons


def leaves(result: Any) -> dict[str, Tensor]:
    """Returns the tensors of a result, by name."""
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
    """Returns whether all values are finite."""
    return all(bool(value.isfinite().all()) for value in leaves(result).values())


def same(result: Any, expected: Any, *, rtol: float = 0.0, atol: float = 0.0) -> bool:
    """Returns whether two results have the same entries with the same types and values."""
    one, other = leaves(result), leaves(expected)
    return one.keys() == other.keys() and all(
        (one[key].shape, one[key].dtype) == (other[key].shape, other[key].dtype)
        and torch.allclose(one[key].double(), other[key].double(), rtol=rtol, atol=atol, equal_nan=False)
        for key in one
    )


def kept(result: Any, expected: Any, *, most: int = 1, rtol: float = 0.0) -> bool:
    """Returns whether rows are as expected, except for some that are masked, or missing at the end.

    Args:
        result: entries ``[N, ...]``.
        expected: the same, maybe longer; its boolean entries are masks, False for missing readings.
        most: largest number of masked rows.
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
