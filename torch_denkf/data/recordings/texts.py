"""Parses tables in text files: comments, separator, names of columns, cells."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torch_denkf.data.recordings.stamps import DATE_AND_TIME, seconds_of
from torch_denkf.data.text import read_number

__all__ = ["Cells", "as_number", "is_number", "numbered", "read_cells"]

LARGEST = float(np.finfo(np.float32).max)
_COMMENTS = ("#", "%", "@", "//")
_TUM = ("time", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_KITTI = ("r00", "r01", "r02", "x", "r10", "r11", "r12", "y", "r20", "r21", "r22", "z")


class Cells(NamedTuple):
    """A table as text.

    Attributes:
        names: names of the columns.
        rows: cells of each row, which may be too few.
        lines: line of the file at which each row ends.
        headless: whether the file does not name its columns.
    """

    names: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]
    headless: bool


def read_cells(file: Path, columns: Sequence[str] | None = None) -> Cells:
    """Reads a table from a text file with any separator.

    Args:
        file: a text in UTF-8. Lines that begin with ``#``, ``%``, ``@`` or ``//`` are comments; the last of them above
            the numbers names the columns if it has as many cells.
        columns: names of all columns, for a file without a header.

    Raises:
        FileNotFoundError: without the file.
        ValueError: if it is no table.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no table {file}; check the path")
    try:
        lines = file.read_text("utf-8-sig").splitlines(keepends=True)
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is no text in UTF-8 ({error}); store it again as CSV in UTF-8") from error
    said = [line.lstrip().startswith(_COMMENTS) for line in lines]
    texts = ["\n" if comment else line for line, comment in zip(lines, said, strict=True)]
    first = next((place for place, text in enumerate(texts) if text.strip(", ;\t\r\n")), len(texts))
    head = texts[first] if first < len(texts) else ""
    if head.lstrip().startswith(("{", "<")):
        raise ValueError(f"{file} is JSON or XML, no table: write a line of numbers a reading, CSV")
    mark = _separator(head)
    rows, ends = _split(file, texts, mark)
    names: Sequence[str] = [name.strip() for name in rows[0]] if rows else []
    headless = bool(rows) and not _is_head(rows[0])
    if rows and not headless:
        del rows[0], ends[0]
        while names and not names[-1]:
            names = names[:-1]
        if len(rows) > 1 and _is_head(rows[0]) and not _is_head(rows[1]) and not any(map(is_number, rows[0])):
            names = [f"{name} [{unit.strip(' []()')}]" for name, unit in zip(names, rows[0], strict=False)]
            del rows[0], ends[0]
    elif headless:
        above = next((line for line in reversed(lines[:first]) if line.strip()), "").lstrip().lstrip("#%@/ ")
        named, _ = _split(file, [above], mark)
        names = _named(file, rows[0], named[0] if named else [], columns)
    for row, end in zip(rows, ends, strict=True):
        if any(map(str.strip, row[len(names) :])):
            raise ValueError(
                f"{file}:{end}: {len(row)} cells for {len(names)} columns; write decimals with points, and name every "
                f"column in the first line, which separates them by {_SAID[mark]}"
            )
    return Cells(numbered(names), rows, ends, headless)


_SAID = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars"}


def _separator(head: str) -> str:
    """Returns the separator of the first line; a blank if there is no other."""
    for mark in ("\t", ";", ",", "|"):
        if mark in head and not (mark == "\t" and "" in map(str.strip, head.strip().split("\t"))):
            return mark
    return " "


def _split(file: Path, lines: Sequence[str], mark: str) -> tuple[list[list[str]], list[int]]:
    """Returns the cells of all lines that are not empty, and the line at which each row ends."""
    rows, ends = [], []
    if mark == " ":
        for place, line in enumerate(lines):
            if cells := DATE_AND_TIME.sub(r"\1T\2", line).split():
                rows.append(cells)
                ends.append(place + 1)
        return rows, ends
    reader = csv.reader(lines, delimiter=mark)
    try:
        for row in reader:
            if any(map(str.strip, row)):
                rows.append([_pointed(cell) for cell in row] if mark == ";" else row)
                ends.append(reader.line_num)
    except csv.Error as error:
        raise ValueError(f"{file}:{reader.line_num}: {error}; store it again as CSV") from error
    return rows, ends


def _pointed(cell: str) -> str:
    """Replaces a decimal comma by a point, for files whose columns are separated by semicolons."""
    return re.sub(r"^(\s*[-+]?\d+),(\d+)", r"\1.\2", cell)


def _is_head(row: Sequence[str]) -> bool:
    """Returns True for a row of names or units, which has no number, date or NaN."""
    filled = [cell for cell in map(str.strip, row) if cell]
    return not any(is_number(cell) or cell.lower() == "nan" or seconds_of(cell) is not None for cell in filled)


def _named(file: Path, row: Sequence[str], comment: Sequence[str], columns: Sequence[str] | None) -> Sequence[str]:
    """Returns names of the columns of a file without a header.

    Raises:
        ValueError: if the names are unknown.
    """
    count = len(row) if row[-1].strip() else len(row) - 1
    if columns is not None and len(columns) == count:
        return columns
    if len(comment) == count and not any(map(is_number, comment)):
        return [name.strip() for name in comment]
    numbers = np.array([as_number(cell) for cell in row[:count]])
    if count == 1:
        return ["time"]
    if count == 8 and abs(np.square(numbers[4:]).sum() - 1) < 0.02:
        return _TUM
    if count == 12 and np.allclose(np.linalg.norm(numbers.reshape(3, 4)[:, :3], axis=1), 1, atol=0.02):
        return _KITTI
    raise ValueError(
        f"{file} has {count} columns without names: its first line must name the columns, or pass columns= with "
        f"{count} names, the time's included" + (f"; got {list(columns)}" if columns else "")
    )


def numbered(names: Sequence[str]) -> tuple[str, ...]:
    """Returns names of columns, in which repeated names get a number, as in pandas.

    Examples:
        >>> numbered(["t", "x", "x"])
        ('t', 'x', 'x.1')
    """
    seen: Counter[str] = Counter()
    out = []
    for name in names:
        out.append(f"{name}.{seen[name]}" if seen[name] else name)
        seen[name] += 1
    return tuple(out)


def as_number(text: str) -> float:
    """Returns a finite number in the range of float32; NaN for other text."""
    try:
        number = read_number(text)
    except ValueError:
        return math.nan
    return number if abs(number) <= LARGEST else math.nan


def is_number(text: str) -> bool:
    """Returns True if a text is a finite number."""
    return not math.isnan(as_number(text))
