"""Readings in tables, CSV or Parquet: a time and some numbers a row."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from torch_denkf._checks import check_number
from torch_denkf.data.parquet import read_parquet
from torch_denkf.data.text import read_number
from torch_denkf.data.times import Way
from torch_denkf.diagnosis.logs import SECONDS, Unit, in_origin, look_at_numbers, look_at_times

__all__ = ["Readings", "Table", "Unit", "check_times", "read_numbers"]

LARGEST = float(np.finfo(np.float32).max)


class Readings(NamedTuple):
    """Content of a table.

    Attributes:
        times: when they were taken, s, ascending, ``[n]``.
        values: ``[n, C]``.
        columns: names of the values.
        arrived: when they could be read, s, ``[n]``; None where that is when they were taken.
        until: s, the table's end, where it repeats the last reading up to there.
    """

    times: np.ndarray
    values: np.ndarray
    columns: tuple[str, ...]
    arrived: np.ndarray | None = None
    until: float | None = None


@dataclass(frozen=True)
class Table:
    r"""Readings of a sensor, states or commands: a CSV file with a header, or a Parquet file.

    Args:
        file: ends in ``.csv``, ``.txt`` or ``.tsv`` (tabs), or ``.parquet``.
        columns: names of the columns to read, in this order; by default all but the times.
        time: name of the column of times, when each reading was taken; they ascend.
        arrived: name of a column of times at which the readings arrived, on the same clock, where they come late. A row
            of the data set shows the last one that had arrived, and ``NAME_late`` says by how many rows it is late, as
            :class:`~torch_denkf.fusion.FusedSensor` reads it. With ``sample="last"`` alone.
        unit: of the times: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``.
        sample: which reading a row of the data set gets. ``"last"``: the last one up to then, held until the next.
            These two look into the future: ``"nearest"``, the nearest in time, before or after; ``"linear"``, straight
            lines between the readings before and after (unwrap angles first).
        tolerance: in s. With ``"last"`` and ``"nearest"``, readings that are farther away count as missing: by
            default, none with ``"last"``, half a row's time with ``"nearest"``. With ``"linear"``, no value between
            readings that are farther apart; by default there always is one.
        origin: what is subtracted from columns, by their names, in float64, before they become float32, which has seven
            digits: of metres of a map, degrees of latitude or encoder ticks the last ones are lost. A warning says
            where.
        repeats: what a row is in which no column differs from the row before. ``"drop"``: the last reading once more,
            as in a log that repeats a slow sensor until it reads again; the row is left out. ``"keep"``: a reading of
            its own. By default it is kept, and a warning says where a column looks as if it repeats.

    Raises:
        ValueError: for an unknown ``unit``, ``sample`` or ``repeats``, tolerances that are not positive, and
            ``arrived`` with another ``sample`` than ``"last"``.

    Examples:
        >>> from tempfile import mkdtemp
        >>> file = Path(mkdtemp()) / "imu.csv"
        >>> _ = file.write_text("t,wx,wy\n0,1,2\n10,3,4\n")
        >>> Table(file, ["wy"], time="t", unit="ms").read().values
        array([[2.],
               [4.]])
    """

    file: str | Path
    columns: Sequence[str] | None = None
    time: str = "time"
    unit: Unit = "s"
    sample: Way = "last"
    tolerance: float | None = None
    arrived: str | None = None
    origin: Mapping[str, float] | None = None
    repeats: Literal["drop", "keep"] | None = None

    def __post_init__(self):
        check_stream(self.sample, ("last", "nearest", "linear"), self.tolerance, self.unit)
        if self.repeats not in (None, "drop", "keep"):
            raise ValueError(f"repeats is 'drop', 'keep' or None, got {self.repeats!r}")
        if not (self.origin is None or isinstance(self.origin, Mapping)):
            raise TypeError(
                f"origin holds numbers by the names of columns, such as {{'x': 5.4e6}}; got {self.origin!r}"
            )
        if self.arrived is not None and self.sample != "last":
            raise ValueError(
                f"arrived={self.arrived!r} says when a reading can be known, which sample={self.sample!r} does not "
                "wait for; pass sample='last', or leave arrived out"
            )

    def read(self) -> Readings:
        """Returns the whole table.

        Raises:
            FileNotFoundError: without the file.
            ImportError: for Parquet, without pyarrow.
            ValueError: for columns that are not there, values that are no finite numbers, times that do not ascend, and
                readings that arrive before they are taken; names the file, the line and the column.
        """
        if self.columns is not None and not isinstance(self.columns, Sequence):
            raise TypeError(f"columns is a list of names, or None; got {self.columns!r}")
        columns = None if self.columns is None else list(self.columns)
        if isinstance(self.columns, str):
            raise ValueError(f"columns is a list of names, such as [{self.columns!r}]; got {self.columns!r}")
        if self.arrived is not None and columns is not None:
            columns = [*columns, self.arrived]
        names, numbers, place = read_numbers(Path(self.file).expanduser(), self.time, columns)
        times, values, arrived = numbers[:, 0] * SECONDS[self.unit], numbers[:, 1:], None
        check_times(times, place, self.time)
        look_at_times(times, self.file, self.time, self.unit)
        if self.arrived is not None:
            if self.arrived not in names:
                raise ValueError(f"{self.file} lacks the column {self.arrived!r} of arrivals; it has {list(names)}")
            at = names.index(self.arrived) if columns is None else len(names) - 1
            names, arrived = names[:at] + names[at + 1 :], values[:, at] * SECONDS[self.unit]
            values = np.delete(values, at, 1)
            early = np.flatnonzero(arrived < times)
            if len(early):
                row = int(early[0])
                raise ValueError(
                    f"{place(row)}: {self.arrived!r} is {arrived[row]:.15g} s, before {self.time!r}, {times[row]:.15g} "
                    "s; a reading arrives after it was taken: exchange the two columns, or correct them"
                )
        if not names:
            raise ValueError(f"{self.file} has no column to read besides {self.time!r}; leave the stream out")
        if unknown := set(self.origin or ()) - set(names):
            raise ValueError(f"origin names {sorted(map(str, unknown))}, but {self.file} is read for {list(names)}")
        for name, origin in (self.origin or {}).items():
            column = [names.index(name)]
            values[:, column] = in_origin(values[:, column], origin, f"origin of {name!r}")
        look_at_numbers(values, names, self.file)
        if self.repeats != "drop":
            return Readings(times, values, names, arrived)
        new, until = np.append(True, (np.diff(values, axis=0) != 0).any(1)), times if arrived is None else arrived
        return Readings(times[new], values[new], names, None if arrived is None else arrived[new], float(until.max()))


def check_stream(sample: str, ways: Sequence[str], tolerance: float | None, unit: str) -> None:
    """Raises for options that no stream has.

    Raises:
        ValueError: if there is one.
    """
    if sample not in ways:
        raise ValueError(f"sample is one of {', '.join(map(repr, ways))}, got {sample!r}")
    if unit not in SECONDS:
        raise ValueError(f"unit is one of {', '.join(map(repr, SECONDS))}, got {unit!r}")
    if tolerance is not None:
        check_number("tolerance", tolerance, above=0, cure="It is a time in s, or None")


def check_times(times: np.ndarray, place: Callable[[int], str], column: str) -> None:
    """Raises for times that stand still or go back.

    Args:
        times: s, ``[n]``.
        place: where a row is, for a message.
        column: name of their column.

    Raises:
        ValueError: if there are none, or one is not finite or does not ascend.
    """
    if not len(times):
        raise ValueError(f"{place(-1)} has no rows; leave the stream out")
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise ValueError(f"{place(int(bad[0]))}: {column!r} is {times[bad[0]]}; times are finite numbers")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        k = int(back[0]) + 1
        raise ValueError(
            f"{place(k)}: {column!r} goes from {times[k - 1]:.15g} to {times[k]:.15g} s; times must ascend: sort the "
            "rows, or take those out that are there twice"
        )


def read_numbers(
    file: Path, time: str, columns: Sequence[str] | None
) -> tuple[tuple[str, ...], np.ndarray, Callable[[int], str]]:
    """Reads columns of a table: names without the time's, numbers ``[n, 1 + C]``, each row's place in the file.

    Raises:
        FileNotFoundError: without the file.
        ImportError: for Parquet, without pyarrow.
        ValueError: for columns that are not there, and values that are no finite numbers.
    """
    read = _read_parquet if file.suffix.lower() in (".parquet", ".pq") else _read_csv
    return read(file, time, columns)


def _choose(file: Path, there: Sequence[str], time: str, columns: Sequence[str] | None) -> list[str]:
    names = [time, *([name for name in there if name != time] if columns is None else columns)]
    count = Counter(there)
    missing = [name for name in names if not count[name]]
    if missing:
        raise ValueError(f"{file} lacks the columns {missing}; it has {list(there)}: {_hint(there, time, missing)}")
    twice = [name for name in names if count[name] > 1]
    if twice:
        raise ValueError(f"{file} has two columns {twice[0]!r}; give one another name, or pass columns= without it")
    return names


def _hint(there: Sequence[str], time: str, missing: Sequence[str]) -> str:
    """Returns advice for columns that are missing."""
    if len(there) == 1 and set(missing) & set(re.split(r"[;\t |]+", there[0])):
        return "separate columns by commas, or by tabs in a .tsv"
    if there and all(map(_is_number, there)):
        return "its first line must name the columns"
    return "pass time= for the column of times" if time in missing else "pass columns= of those"


def _number(text: str) -> float:
    """Returns a finite number that float32 can hold; NaN for what is none."""
    try:
        number = read_number(text)
    except ValueError:
        return math.nan
    return number if abs(number) <= LARGEST else math.nan


def _is_number(text: str) -> bool:
    return not math.isnan(_number(text))


def _no_number(place: str, column: str, value: object) -> ValueError:
    return ValueError(
        f"{place}: {column!r} is {value!r}, which is no finite number; correct it, or leave the row out: what is "
        "missing then counts as not observed"
    )


def _read_csv(file: Path, time: str, columns: Sequence[str] | None):
    if not file.is_file():
        raise FileNotFoundError(f"no table {file}; check the path")
    numbers: list[list[float]] = []
    lines: list[int] = []
    try:
        with file.open(newline="", encoding="utf-8-sig") as opened:
            reader = csv.reader(opened, delimiter="\t" if file.suffix.lower() == ".tsv" else ",")
            filled = (row for row in reader if any(map(str.strip, row)))
            there = [name.strip() for name in next(filled, [])]
            names = _choose(file, there, time, columns)
            places = {name: place for place, name in enumerate(there)}
            where = [places[name] for name in names]
            for row in filled:
                place = f"{file}:{reader.line_num}"
                if any(map(str.strip, row[len(there) :])):
                    raise ValueError(
                        f"{place}: {len(row)} cells for {len(there)} columns; write decimals with points, and name "
                        "every column in the first line"
                    )
                texts = [row[column] if column < len(row) else "" for column in where]
                numbers.append([_number(text) for text in texts])
                if math.isnan(sum(numbers[-1])):
                    name, text = next(pair for pair in zip(names, texts, strict=True) if not _is_number(pair[1]))
                    raise _no_number(place, name, text)
                lines.append(reader.line_num)
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is no text in UTF-8 ({error}); store it again as CSV in UTF-8") from error
    except csv.Error as error:
        raise ValueError(f"{file}:{reader.line_num}: {error}; store it again as CSV") from error
    table = np.array(numbers, dtype=np.float64).reshape(-1, len(names))
    return tuple(names[1:]), table, lambda row: f"{file}:{lines[row]}" if lines else str(file)


def _read_parquet(file: Path, time: str, columns: Sequence[str] | None):
    wanted = None if columns is None else [time, *columns]
    table = read_parquet(file) if wanted is None else read_parquet(file, list(dict.fromkeys(wanted)))
    names = _choose(file, table.column_names, time, columns)
    numbers = np.empty((table.num_rows, len(names)))
    for column, name in enumerate(names):
        values = table[name].to_numpy()
        if values.dtype.kind == "M":  # it would become a count of days, or of milliseconds
            raise ValueError(
                f"{file}: {name!r} holds {table[name].type}; store it as a number, such as the ns since 1970, and "
                "pass unit='ns'"
            )
        try:
            numbers[:, column] = values.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{file}: {name!r} holds {table[name].type}, not a number a row; pass columns= without it"
            ) from error
        bad = np.flatnonzero(~(np.abs(numbers[:, column]) <= LARGEST))
        if len(bad):
            raise _no_number(f"{file}, row {bad[0]} (from 0)", name, table[name][int(bad[0])].as_py())
    return tuple(names[1:]), numbers, lambda row: f"{file}, row {row} (from 0)" if table.num_rows else str(file)
