"""Reads columns and times of a table as numbers, from text, Parquet or ROS bags."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torch_denkf.data.parquet import parquet_names, read_parquet
from torch_denkf.data.recordings.bags import is_bag, read_topic
from torch_denkf.data.recordings.stamps import nanoseconds_beside, seconds_of, time_columns
from torch_denkf.data.recordings.texts import LARGEST, as_number, numbered, read_cells

__all__ = ["Numbers", "Source", "open_source", "read_numbers", "sparse_columns"]


class Source:
    """Base class of tables whose columns are read one by one.

    Attributes:
        names: names of the columns.
        headless: whether the file has no header, so that the names were passed.
        asides: names of columns that are read only if requested.
    """

    names: Sequence[str]
    headless = False
    asides: tuple[str, ...] = ()

    def column(self, name: str) -> np.ndarray:
        """Returns the numbers of a column ``[n]``, NaN for text."""
        raise NotImplementedError

    def stamps(self, name: str) -> np.ndarray:
        """Returns a column of times ``[n]``, dates as seconds, plus the column of nanoseconds if there is one."""
        rest = nanoseconds_beside(name, self.names)
        return self.column(name) if rest is None else self.column(name) + 1e-9 * self.column(rest)

    def empty(self, name: str) -> np.ndarray:
        """Masks empty cells, bool ``[n]``."""
        return np.zeros(len(self.column(name)), bool)

    def cell(self, name: str, row: int) -> Any:
        """Returns the content of a cell, for messages."""
        return self.column(name)[row]

    def place(self, row: int) -> str:
        """Returns the place of a row for messages; -1 for the table."""
        raise NotImplementedError


class _Text(Source):
    def __init__(self, file: Path, columns: Sequence[str] | None):
        self.file, self.table = file, read_cells(file, columns)
        self.names, self.headless = self.table.names, self.table.headless
        self._places = {name: place for place, name in enumerate(self.names)}

    def _cells(self, name: str) -> list[str]:
        at = self._places[name]
        return [row[at] if at < len(row) else "" for row in self.table.rows]

    def column(self, name):
        return np.array([as_number(cell) for cell in self._cells(name)])

    def stamps(self, name):
        times, cells = super().stamps(name), self._cells(name)
        days = self._cells("date") if "date" in self.names and name != "date" else [""] * len(cells)
        for row in np.flatnonzero(np.isnan(times)):
            found = seconds_of(f"{days[row]} {cells[row]}" if days[row] else cells[row])
            times[row] = np.nan if found is None else found
        return times

    def empty(self, name):
        at = self._places[name]
        return np.array([at < len(row) and not row[at].strip() for row in self.table.rows], bool)

    def cell(self, name, row):
        return self._cells(name)[row]

    def place(self, row):
        return f"{self.file}:{self.table.lines[row]}" if self.table.lines else str(self.file)


class _Parquet(Source):
    def __init__(self, file: Path):
        self.file, self.names = file, parquet_names(file)
        if len(set(self.names)) < len(self.names):
            raise ValueError(f"{file} has two columns of one name in {self.names}; give one another name")

    def column(self, name):
        column = read_parquet(self.file, [name])[name]
        values = column.to_numpy()
        if values.dtype.kind == "M":  # it would become a count of days, or of milliseconds
            raise ValueError(f"{self.file}: {name!r} holds {column.type}, not a number a row; pass columns= without it")
        try:
            numbers = values.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{self.file}: {name!r} holds {column.type}, not a number a row; pass columns= without it"
            ) from error
        return np.where(np.abs(numbers) <= LARGEST, numbers, np.nan)

    def stamps(self, name):
        values = read_parquet(self.file, [name])[name].to_numpy()
        if values.dtype.kind != "M":
            return super().stamps(name)
        return np.where(np.isnat(values), np.nan, values.astype("datetime64[ns]").astype(np.int64) * 1e-9)

    def empty(self, name):
        return read_parquet(self.file, [name])[name].is_null().to_numpy()

    def cell(self, name, row):
        return read_parquet(self.file, [name])[name][row].as_py()

    def place(self, row):
        return str(self.file) if row < 0 else f"{self.file}, row {row} (from 0)"


class _Topic(Source):
    asides = ("recorded", "header.seq")

    def __init__(self, file: Path, topic: str | None):
        self.file, (self.topic, self.columns) = file, read_topic(file, topic)
        self.names = numbered(list(self.columns))

    def column(self, name):
        return self.columns[name]

    def place(self, row):
        return f"{self.file}, {self.topic}" if row < 0 else f"{self.file}, {self.topic}, message {row} (from 0)"


def open_source(file: Path, columns: Sequence[str] | None = None, topic: str | None = None) -> Source:
    """Opens a table.

    Args:
        file: file of a :class:`~torch_denkf.data.Table`.
        columns: names of all columns, for a text without a header.
        topic: of a bag.

    Raises:
        FileNotFoundError: without the file.
        ImportError: for Parquet without pyarrow, for bags without rosbags.
        ValueError: if it cannot be read.
    """
    if is_bag(file):
        return _Topic(file, topic)
    if topic is not None:
        raise ValueError(f"{file} is no ROS bag, and has no topic {topic!r}; pass columns=")
    return _Parquet(file) if file.suffix.lower() in (".parquet", ".pq") else _Text(file, columns)


class Numbers(NamedTuple):
    """Columns of a table.

    Attributes:
        times: times in the unit of the file, ``[n]``.
        time: name of the column of times.
        values: ``[n, C]``.
        names: names of the columns ``[C]``.
        place: returns the place of a row in the file, for messages.
    """

    times: np.ndarray
    time: str
    values: np.ndarray
    names: tuple[str, ...]
    place: Callable[[int], str]


def read_numbers(
    file: Path, time: str | None, columns: Sequence[str] | None, timeless: bool = False, topic: str | None = None
) -> Numbers:
    """Reads columns of a table.

    Args:
        file: file of a :class:`~torch_denkf.data.Table`.
        time: name of the column of times; ``None`` for the first ascending one with a usual name, or the column of
            dates.
        columns: columns to read; ``None`` for all other numeric columns.
        timeless: whether the table has no times.
        topic: topic of a bag.

    Raises:
        FileNotFoundError: without the file.
        ImportError: for Parquet without pyarrow, for bags without rosbags.
        ValueError: for missing columns, and values that are no finite numbers.
    """
    source = open_source(file, columns, topic)
    there = source.names
    found = [] if timeless else _found(source, time)
    missing = [name for name in [*found, *(columns or ())] if name not in there]
    if missing:
        cure = (
            "pass time= for the column of times, or times= where it has none"
            if set(missing) & set(found)
            else "pass columns= of those"
        )
        raise ValueError(f"{file} lacks the columns {missing}; it has {list(there)}: {cure}")
    stamps = {name: source.stamps(name) for name in found}
    chosen = next((name for name in found if len(found) > 1 and (np.diff(stamps[name]) > 0).all()), (found or [""])[0])
    own = [chosen, nanoseconds_beside(chosen, there), *source.asides, *(found if time is None else ())]
    if columns is None or source.headless:
        columns = [name for name in (columns or there) if name not in own]
        read = {name: source.column(name) for name in columns}
        if not source.headless:  # skips columns of text
            read = {name: column for name, column in read.items() if not len(column) or np.isfinite(column).any()}
    else:
        read = {name: source.column(name) for name in columns}
    names = tuple(read)
    count = len(next(iter(read.values()))) if read else len(stamps[chosen]) if found else len(source.column(there[0]))
    values = np.array(list(read.values())).reshape(len(names), count).T
    kept = np.arange(count)
    if names and np.isnan(values).all(1).any():
        kept = np.flatnonzero(~np.all([source.empty(name) for name in names], 0))
    times, values = (stamps[chosen] if found else np.arange(float(count)))[kept], values[kept]
    bad = np.flatnonzero(np.isnan(times) | np.isnan(values).any(1))
    if len(bad):
        row = int(bad[0])
        name = chosen if np.isnan(times[row]) else names[int(np.isnan(values[row]).argmax())]
        cure = "correct it, or leave the row out: what is missing then counts as not observed"
        if len(names) > 1 and name in names and source.empty(name)[kept[row]]:
            cure = (
                f"columns that are empty in other rows are tables of their own: pass columns=[{name!r}], and the others"
            )
        raise ValueError(
            f"{source.place(int(kept[row]))}: {name!r} is {source.cell(name, int(kept[row]))!r}, which is no finite "
            f"number; {cure}"
        )
    return Numbers(
        times, chosen or "times", values, names, lambda row: source.place(int(kept[row]) if len(kept) else -1)
    )


def sparse_columns(file: Path, time: str | None = None) -> tuple[list[str], list[list[str]]]:
    """Returns the columns of numbers with one in each row, and groups of those that are empty in the same rows.

    Args:
        file: of a :class:`~torch_denkf.data.Table`.
        time: as of :func:`read_numbers`.

    Returns:
        Two empty lists where no row lacks a number that others have.

    Raises:
        FileNotFoundError: without the file.
        ImportError: for Parquet without pyarrow.
        ValueError: if it cannot be read.
    """
    source = open_source(file)
    empty = {name: source.empty(name) for name in source.names}
    if not any(one.any() and not one.all() for one in empty.values()):
        return [], []
    clock = _found(source, time)
    clock += [beside for name in clock if (beside := nanoseconds_beside(name, source.names))]
    groups: dict[bytes, list[str]] = {}
    for name, one in empty.items():
        if name not in clock and np.isfinite(source.column(name)).any():
            groups.setdefault(one.tobytes(), []).append(name)
    full = groups.pop(bytes(len(one)), [])
    return full, list(groups.values())


def _found(source: Source, time: str | None) -> list[str]:
    """Lists the columns that may hold the times."""
    return [time] if time is not None else time_columns(source.names) or _dates(source) or ["time"]


def _dates(source: Source) -> list[str]:
    """Returns the column whose first cell is a date, if there is exactly one."""
    try:
        found = [name for name in source.names if seconds_of(str(source.cell(name, 0))) is not None]
    except (IndexError, NotImplementedError):  # no row, or no text
        return []
    return found if len(found) == 1 else []
