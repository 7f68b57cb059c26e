"""Tables of readings, from text, Parquet or a topic of a ROS bag: each row has a time and values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from torch_denkf._checks import check_number
from torch_denkf.data.earth import to_local
from torch_denkf.data.recordings.sources import read_numbers
from torch_denkf.data.recordings.stamps import unit_of
from torch_denkf.data.times import Way
from torch_denkf.diagnosis.logs import SECONDS, Unit, in_origin, look_at_numbers, look_at_times

__all__ = ["Readings", "Table", "Unit", "changes", "check_times", "given_times"]


class Readings(NamedTuple):
    """Content of a table.

    Attributes:
        times: measurement times, s, ascending, ``[n]``.
        values: ``[n, C]``.
        columns: names of the values.
        arrived: arrival times, s, ``[n]``; None if they equal the measurement times.
        until: time of the last row, s, if the table repeats its last reading up to there.
    """

    times: np.ndarray
    values: np.ndarray
    columns: tuple[str, ...]
    arrived: np.ndarray | None = None
    until: float | None = None


@dataclass(frozen=True)
class Table:
    r"""Readings of a sensor, states or commands, from a text or Parquet file, or a topic of a ROS bag.

    Text may be separated by commas, semicolons, tabs, bars or blanks. Lines that begin with ``#``, ``%``, ``@`` or
    ``//`` are comments, the last of which above the numbers may name the columns. Files in the formats of TUM and
    KITTI, which have no header, get the names ``time, tx, ty, tz, qx, qy, qz, qw`` and ``r00, r01, r02, x, ...``. A
    repeated name becomes ``NAME.1``. Rows whose columns are all empty are no readings.

    Args:
        file: ends in ``.parquet``; in ``.bag``, ``.db3`` or ``.mcap``, or is a folder, for a ROS bag, which needs
            ``pip install 'torch_denkf[ros]'``; all else is text.
        columns: names of the columns to read, in this order; by default all numeric columns except the times. For a
            file without a header: names of all its columns, including the time.
        time: name of the column with the measurement times, ascending. They are numbers, dates, or whole seconds with
            the nanoseconds in another column. By default the first ascending column with a usual name, such as
            ``time``, ``timestamp`` or ``header.stamp.secs``.
        arrived: name of a column with the arrival times of delayed readings, on the same clock. A row of the data set
            has the last reading that had arrived, and ``NAME_late`` is its latency in rows, an input of
            :class:`~torch_denkf.fusion.FusedSensor`. Only with ``sample="last"``.
        unit: of the times: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``. By default from the column's name, such as
            ``timestamp [ns]``; or from the size of stamps since 1970; else ``"s"``.
        times: times of the rows, for a table without times: another file with as many rows, or an array.
        topic: topic of a ROS bag; by default the only one. Columns are the fields of its messages, such as
            ``twist.twist.linear.x``, numbered in arrays.
        offset: in s, added to all times, such as -0.7 for readings that are stamped 0.7 s late.
            :func:`~torch_denkf.data.clock_offsets` estimates it.
        sample: interpolation to the rows of the data set. ``"last"``: the last reading up to the row's time, a
            zero-order hold, with a delay of up to one row. The other two use future readings: ``"nearest"``, the
            nearest in time, for smoothing; ``"linear"``, linear interpolation (unwrap angles first).
        tolerance: in s. With ``"last"`` and ``"nearest"``, readings that are farther away count as missing: by default
            no limit with ``"last"``, half a row's time with ``"nearest"``. With ``"linear"``, there is no value between
            readings that are farther apart; by default there is no limit.
        origin: offsets that are subtracted from columns, by name, in float64, before the conversion to float32, which
            has seven digits: metres of a map, degrees of latitude or encoder ticks lose their last ones. A warning says
            where.
        local: latitude and longitude in degrees, and optionally the height in m, of the origin of a local frame:
            columns of latitude, longitude and optionally height, in this order, become metres ``east``, ``north`` and
            ``up``, see :mod:`torch_denkf.data.earth`.
        repeats: treatment of rows that equal the row before. ``"drop"`` leaves them out, for a log that repeats the
            last reading of a slow sensor. ``"keep"`` takes them for new readings. The default keeps them, and warns of
            columns that look repeated.

    Raises:
        ValueError: for an unknown ``unit``, ``sample`` or ``repeats``, tolerances that are not positive, an ``offset``
            that is not finite, and ``arrived`` with a ``sample`` other than ``"last"``.

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
    time: str | None = None
    unit: Unit | None = None
    sample: Way = "last"
    tolerance: float | None = None
    arrived: str | None = None
    origin: Mapping[str, float] | None = None
    repeats: Literal["drop", "keep"] | None = None
    times: str | Path | Sequence[float] | None = None
    topic: str | None = None
    offset: float = 0.0
    local: Sequence[float] | None = None

    def __post_init__(self):
        check_stream(self.sample, ("last", "nearest", "linear"), self.tolerance, self.unit)
        check_number("offset", self.offset, cure="It is a time in s")
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
            ValueError: for missing columns, values that are no finite numbers, times that do not ascend, and readings
                that arrive before they are taken; the message names the file, the line and the column.
        """
        if self.columns is not None and not isinstance(self.columns, Sequence):
            raise TypeError(f"columns is a list of names, or None; got {self.columns!r}")
        columns = None if self.columns is None else list(self.columns)
        if isinstance(self.columns, str):
            raise ValueError(f"columns is a list of names, such as [{self.columns!r}]; got {self.columns!r}")
        if self.arrived is not None and columns is not None:
            columns = [*columns, self.arrived]
        file = Path(self.file).expanduser()
        times, time, values, names, place = read_numbers(file, self.time, columns, self.times is not None, self.topic)
        if self.times is not None:
            times, place = given_times(self.times, self.time, str(self.file), len(values), "rows")
        unit = self.unit or unit_of(time, times)
        times, arrived = times * SECONDS[unit] + self.offset, None
        check_times(times, place, time)
        look_at_times(times, self.file, time, unit)
        if self.arrived is not None:
            if self.arrived not in names:
                raise ValueError(f"{self.file} lacks the column {self.arrived!r} of arrivals; it has {list(names)}")
            at = names.index(self.arrived) if columns is None else len(names) - 1
            names, arrived = names[:at] + names[at + 1 :], values[:, at] * SECONDS[unit] + self.offset
            values = np.delete(values, at, 1)
            early = np.flatnonzero(arrived < times)
            if len(early):
                row = int(early[0])
                raise ValueError(
                    f"{place(row)}: {self.arrived!r} is {arrived[row]:.15g} s, before {time!r}, {times[row]:.15g} "
                    "s; a reading arrives after it was taken: exchange the two columns, or correct them"
                )
        if not names:
            raise ValueError(f"{self.file} has no column to read beside {time!r}; leave the stream out")
        if unknown := set(self.origin or ()) - set(names):
            raise ValueError(f"origin names {sorted(map(str, unknown))}, but {self.file} is read for {list(names)}")
        for name, origin in (self.origin or {}).items():
            column = [names.index(name)]
            values[:, column] = in_origin(values[:, column], origin, f"origin of {name!r}")
        if self.local is not None:
            values, names = to_local(values, self.local), ("east", "north", "up")[: len(names)]
        look_at_numbers(values, names, self.file)
        if self.repeats != "drop":
            return Readings(times, values, names, arrived)
        new, until = changes(values), times if arrived is None else arrived
        return Readings(times[new], values[new], names, None if arrived is None else arrived[new], float(until.max()))


def changes(values: np.ndarray) -> np.ndarray:
    """Marks the rows ``[N]`` of readings ``[N, D]`` that differ from the row before; the first one does.

    Examples:
        >>> changes(np.array([[1.0], [1.0], [2.0]])).tolist(), changes(np.zeros((0, 2))).tolist()
        ([True, False, True], [])
    """
    return np.append(True, (np.diff(values, axis=0) != 0).any(1))[: len(values)]


def check_stream(sample: str, ways: Sequence[str], tolerance: float | None, unit: str | None) -> None:
    """Checks the options of a stream.

    Raises:
        ValueError: for an unknown or invalid option.
    """
    if sample not in ways:
        raise ValueError(f"sample is one of {', '.join(map(repr, ways))}, got {sample!r}")
    if unit is not None and unit not in SECONDS:
        raise ValueError(f"unit is one of {', '.join(map(repr, SECONDS))}, got {unit!r}")
    if tolerance is not None:
        check_number("tolerance", tolerance, above=0, cure="It is a time in s, or None")


def check_times(times: np.ndarray, place: Callable[[int], str], column: str) -> None:
    """Checks that times increase.

    Args:
        times: s, ``[n]``.
        place: returns the place of a row, for a message.
        column: name of the column of times.

    Raises:
        ValueError: if there are none, one is not finite, or they do not ascend.
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


def given_times(
    given: str | Path | Sequence[float], column: str | None, source: str, count: int, what: str
) -> tuple[np.ndarray, Callable[[int], str]]:
    """Returns times that were passed as a file or array, in their own unit, and the place of each, for messages.

    Args:
        given: file with a row for each time, or the times.
        column: column of times in that file.
        source: name of the stream, for messages.
        count: number of the stream's elements.
        what: name of these elements.

    Raises:
        ValueError: if there are not ``count`` times.
    """
    if isinstance(given, (str, Path)):
        read = read_numbers(Path(given).expanduser(), column, [])
        times, place, name = read.times, read.place, str(given)
    else:
        if np.ma.is_masked(given):
            raise ValueError(f"times of {source} has masked elements; pass a time for each of its {what}")
        times, place, name = np.asarray(given, dtype=np.float64).reshape(-1), "times[{}]".format, "times"
    if len(times) != count:
        raise ValueError(f"{name} has {len(times)} times, but {source} has {count} {what}; it needs one for each")
    return times, place
