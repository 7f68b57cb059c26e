"""Small grammars of damage: of values, of files, and comparisons with what comes out of a sound input."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = [
    "BYTES",
    "copied",
    "finite",
    "gone",
    "same",
    "same_but",
    "written",
]

NAN, INF = math.nan, math.inf


# ------------------------------------------------------------------------------------------------------- numbers

Values = dict[str, Any]

_NO_NUMBER: Values = {"text": "much"}
POSITIVE: Values = {"zero": 0.0, "negative": -1.0, "nan": NAN, "inf": INF, **_NO_NUMBER}
NOT_NEGATIVE: Values = {"negative": -1.0, "nan": NAN, "inf": INF, **_NO_NUMBER}
FINITE: Values = {"nan": NAN, "inf": INF, **_NO_NUMBER}
SHARE: Values = {"negative": -0.1, "beyond one": 1.5, "nan": NAN, "inf": INF, **_NO_NUMBER}
COUNT: Values = {"zero": 0, "negative": -3, "fraction": 2.5, **_NO_NUMBER}
LARGE_COUNT: Values = {**COUNT, "one": 1}
COUNT_OR_NONE: Values = {"negative": -3, "fraction": 2.5, **_NO_NUMBER}
CHOICE: Values = {"unknown": "sideways", "a number": 3, "empty": ""}
MODULE: Values = {"nothing": None, "text": "network"}


def dims(size: int) -> Values:
    """Indices of components, none of which fits ``size`` of them."""
    return {
        "beyond the end": [size],
        "far before the start": [-size - 1],
        "twice the same": [0, 0],
        "fraction": [0.5],
        "text": ["x"],
    }


def angles(size: int) -> Values:
    """Indices of angles, likewise; one that is there twice is wrapped twice, and right."""
    return {what: value for what, value in dims(size).items() if what != "twice the same"}


def vector(size: int, *, positive: bool = False, negative: bool = True, length: bool = True) -> Values:
    """Vectors that are none of ``size`` finite numbers; ``positive`` where zero is wrong, too."""

    def of(last: float) -> list[float]:
        return [1.0] * (size - 1) + [last]

    out: Values = {"nan": of(NAN), "inf": of(INF), "text": "much"}
    if length:
        out |= {"too long": [1.0] * (size + 1), "a matrix": torch.ones(size, size + 1)}
    if not negative or positive:
        out["negative"] = of(-0.5)
    if positive:
        out["zero"] = of(0.0)
    return out


def matrix(rows: int, columns: int) -> Values:
    """Matrices that are none of ``rows`` by ``columns`` finite numbers."""
    bad = torch.eye(rows, columns)
    nan, inf = bad.clone(), bad.clone()
    nan[0, -1], inf[-1, 0] = NAN, INF
    return {
        "nan": nan,
        "inf": inf,
        "a row more": torch.eye(rows + 1, columns),
        "a column more": torch.eye(rows, columns + 1),
        "a vector": torch.ones(columns + 1),
        "three dimensions": torch.ones(2, rows, columns),
        "text": "much",
    }


def covariance(size: int) -> Values:
    """Matrices that are no covariance of ``size`` components."""
    skew, minus = torch.eye(size), torch.eye(size)
    skew[0, -1] = 0.5
    minus[-1, -1] = -1.0
    indefinite = torch.ones(size, size) + 0.5 * torch.ones(size, size) - torch.eye(size)
    return {
        **matrix(size, size),
        "not symmetric": skew,
        "negative variance": minus,
        "indefinite": indefinite,
    }


# --------------------------------------------------------------------------------------------------------- files


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


def _flipped(at: float) -> Callable[[bytes], bytes]:
    def flip(data: bytes) -> bytes:
        place = min(int(at * len(data)), len(data) - 1)
        return data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :]

    return flip


#: By name: what happens to a file's bytes.
BYTES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "cut in half": lambda data: data[: len(data) // 2],
    "cut by a byte": lambda data: data[:-1],
    "zeros": lambda data: bytes(len(data)),
    "zeros behind": lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2),
    "not UTF-8": lambda data: b"\xff\xfe\x80" + data,
    "another format": lambda data: b"GIF89a" + data[6:],
    "a byte flipped at the start": _flipped(0.0),
    "a byte flipped in the middle": _flipped(0.5),
    "a byte flipped near the end": _flipped(0.95),
}


def written(file: Path, change: Callable[[bytes], bytes]) -> Path:
    """Damages a file's bytes."""
    file.write_bytes(change(file.read_bytes()))
    return file


# --------------------------------------------------------------------------------------------------- comparisons


def leaves(result: Any) -> dict[str, Tensor]:
    """The tensors of a result, by name."""
    if isinstance(result, Tensor):
        return {"": result}
    if isinstance(result, TensorDictBase):
        return {str(key): result[key] for key in result.keys(True, True) if isinstance(result[key], Tensor)}
    if isinstance(result, dict):
        return {f"{key}{name}": value for key, part in result.items() for name, value in leaves(part).items()}
    if isinstance(result, list | tuple):
        return {f"{key}{name}": value for key, part in enumerate(result) for name, value in leaves(part).items()}
    raise TypeError(f"{type(result).__name__} holds no tensors")


def finite(result: Any) -> bool:
    """Whether all numbers are finite."""
    return all(bool(value.isfinite().all()) for value in leaves(result).values())


def same(result: Any, expected: Any, *, rtol: float = 0.0, atol: float = 0.0) -> bool:
    """Whether two results have the same entries, with the same numbers."""
    one, other = leaves(result), leaves(expected)
    return one.keys() == other.keys() and all(
        one[key].shape == other[key].shape
        and torch.allclose(one[key].double(), other[key].double(), rtol=rtol, atol=atol, equal_nan=False)
        for key in one
    )


def same_but(
    result: Any, expected: Any, rows: Iterable[int], masks: Iterable[str], derived: Iterable[str] = ()
) -> bool:
    """Whether ``rows`` are marked as missing in one of ``masks``, and all other rows are as expected.

    Args:
        result: entries ``[N, ...]``.
        expected: likewise.
        rows: numbers of the damaged ones.
        masks: names of boolean entries; where one is False the row's reading does not count.
        derived: entries that follow from several rows and may differ near the damage; they must be finite.
    """
    one, other = leaves(result), leaves(expected)
    rows, derived = list(rows), set(derived)
    if not other.keys() <= one.keys() or not finite(one):
        return False
    shapes = [key for key in other if one[key].shape != other[key].shape]
    marked = any(
        bool((~one[name].reshape(len(one[name]), -1)[row]).any()) for name in masks if name in one for row in rows
    )
    if shapes or not marked:
        return False
    keep = torch.ones(len(next(iter(other.values()))), dtype=torch.bool)
    keep[rows] = False
    return all(torch.equal(one[key][keep], other[key][keep]) for key in other if key not in derived)
