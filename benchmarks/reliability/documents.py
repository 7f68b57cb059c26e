"""Reads files as trees of values, and writes them again with a wrong value in any place."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import torch
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import INF, NAN
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

Place = tuple[Any, ...]  # keys and indices from the root of a tree


@dataclass(frozen=True)
class Format:
    """A file format, read as a tree of dictionaries, lists and leaves.

    Args:
        load: reads the tree.
        dump: writes it.
        text: whether all leaves are words.
        columns: whether the file has columns of equal length, of which only whole ones may be missing.
    """

    load: Callable[[Path], Any]
    dump: Callable[[Path, Any], Any]
    text: bool = False
    columns: bool = False

    def wrong(self, place: Place, leaf: Any) -> d.Wrong:
        """Returns wrong values for a place of the tree, and its deletion."""
        missing = d.Wrong({} if self.columns and len(place) == 2 else {"missing": d.MISSING})
        return missing if self.columns and len(place) == 1 else wrong_of(leaf, self.text) | missing


def _lines(split: Callable[[str], Any], join: Callable[[Any], str], text: bool = False) -> Format:
    return Format(
        lambda file: [split(line) for line in file.read_text().splitlines()],
        lambda file, rows: file.write_text("".join(f"{join(row)}\n" for row in rows)),
        text,
    )


def _load_arrays(file: Path) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(file.read_bytes())) as stored:
        return dict(stored)


def _load_table(file: Path) -> dict[str, list]:
    table = parquet.read_table(file)
    return {name: table[name].to_pylist() for name in table.column_names}


def _dump_table(file: Path, columns: dict[str, list]) -> None:
    """Writes a table; columns keep their type if their values still fit it."""
    schema = parquet.read_schema(file)

    def column(name: str, values: list) -> pa.Array:
        kinds = [schema.field(name).type] if name in schema.names else []
        for kind in (*kinds, None):
            if kind is not None and pa.types.is_integer(kind) and any(isinstance(value, float) for value in values):
                continue  # a fraction would be cut off
            with suppress(pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError, OverflowError):
                return pa.array(values, kind)
        return pa.array([str(value) for value in values])

    parquet.write_table(pa.table({name: column(name, values) for name, values in columns.items()}), file)


FORMATS = {
    ".json": Format(lambda file: json.loads(file.read_text()), lambda file, tree: file.write_text(json.dumps(tree))),
    ".jsonl": _lines(json.loads, json.dumps),
    ".txt": _lines(str.split, " ".join, text=True),
    ".csv": _lines(lambda line: line.split(","), ",".join, text=True),
    ".npz": Format(_load_arrays, lambda file, arrays: np.savez_compressed(file, allow_pickle=True, **arrays)),
    ".parquet": Format(_load_table, _dump_table, columns=True),
    ".pt": Format(read_checkpoint, write_checkpoint),
    ".safetensors": Format(load_file, lambda file, tensors: save_file(tensors, file)),
}


def edited(change: d.Change) -> d.Change:
    """Applies a change to the contents of a file: in place, or by its return value if that is not ``None``."""

    def act(file: Path) -> None:
        form = FORMATS[file.suffix]
        tree = form.load(file)
        changed = change(tree)
        form.dump(file, tree if changed is None else changed)

    return act


# ---------------------------------------------------------------------------------------------------------- leaves


def _some(*values: Any, often: int = 4) -> d.Wrong:
    """Returns values: the first ``often`` are always tried, the others are drawn."""
    return d.of(*values[:often], others=st.sampled_from(values[often:]))


WORDS = d.of(
    "nan", "inf", "-inf", "far", "1,5", "0x1f", "1e400", "1.2.3", "--1", others=st.text("abcxyz?!").map("?".__add__)
)
TEXTS = _some(
    "", 3, None, "../../../../etc/passwd", "a\0b", "{nothing}", "{episode_index.__class__.__mro__}", "x", [],
    "/etc/passwd", "{", "/dev/zero", "{episode_index[0]}", "{episode_index:01000000000d}", often=7,
)  # fmt: skip
COUNTS = _some("x", None, -3, 1.5, [], {}, 10**12, NAN)
NUMBERS = _some("x", None, NAN, INF, -INF, [], {})
LISTS = _some("x", None, [None], [], {}) | {"one less": lambda old: old[:-1], "nested": lambda old: [old]}
LINES = {"empty": [], "one less": lambda old: old[:-1], "one more": lambda old: [*old, old[-1]]}
TREES = _some("x", None, 3, [], {}, often=3)
CONTENTS = d.of(None, b"", b"nothing" * 10) | {"cut": lambda old: old[:40], "cut by a byte": lambda old: old[:-1]}
SHAPES = {
    "a dimension more": lambda array: array[None],
    "one less": lambda array: array[:-1] if array.ndim else array[None, None],
    "one in the last dimension": lambda array: array[..., :1] if array.ndim else array[None, None],
}
FLOATS = d.Wrong(
    {"nan at the start": (0.0, NAN), "inf at the end": (1.0, INF)},
    d.drawn(st.tuples(st.floats(0, 1), st.sampled_from([NAN, INF, -INF]))),
).each(lambda one: d.spoiled(*one))
OBJECTS = {"an object": np.array([{}], dtype=object), "text": np.array("x")}


def wrong_of(leaf: Any, text: bool = False) -> d.Wrong:
    """Returns wrong values for a leaf."""
    if isinstance(leaf, np.ndarray | torch.Tensor):
        floating = leaf.dtype.kind == "f" if isinstance(leaf, np.ndarray) else leaf.is_floating_point()
        wrong = FLOATS | SHAPES if floating else d.Wrong(SHAPES)
        return wrong | OBJECTS if isinstance(leaf, np.ndarray) else wrong
    if text and isinstance(leaf, list):
        return d.Wrong(LINES)
    kinds = {bytes: CONTENTS, str: WORDS if text else TEXTS, int: COUNTS, float: NUMBERS, list: LISTS, dict: TREES}
    return next((wrong for kind, wrong in kinds.items() if isinstance(leaf, kind)), d.of("x", 3))


def places(tree: Any, here: Place = (), rows: int = 3) -> Iterator[tuple[Place, Any]]:
    """Yields all places of a tree with their values; for long lists only first, middle and last."""
    if here:
        yield here, tree
    if isinstance(tree, dict):
        for name, part in tree.items():
            yield from places(part, (*here, name), rows)
    if isinstance(tree, list):
        some = range(len(tree)) if len(tree) <= rows else (0, len(tree) // 2, len(tree) - 1)
        for row in some:
            yield from places(tree[row], (*here, row), rows)
