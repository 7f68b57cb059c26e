"""Times of a recording: masks and interpolates invalid ones, and assigns readings to rows."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import Literal

import numpy as np

Way = Literal["last", "nearest", "linear"]
Span = Literal["common", "all"]
STILL = 0.1  # median steps: a stamp after a shorter step is a duplicate
FARTHEST = 1e9  # median steps: a stamp farther from the median is invalid (years, at a camera's rate)
MOST_WRONG = 0.1  # largest share of invalid times that are interpolated
SLACK = 1e-6  # s: times that differ by less are the same
MOST_ROWS = 10**8  # of one recording: eleven days at 100 Hz


def sound(times: np.ndarray) -> np.ndarray:
    """Masks stamps that are finite, increase, and are neither duplicates nor far outliers, bool ``[N]``.

    Examples:
        >>> sound(np.array([0.0, np.nan, 2.0, 2.001, 3.0, 1e9, 4.0])).tolist()
        [True, False, True, False, True, False, True]
        >>> sound(np.array([0.0, 1.0, 2.0, 1e300])).tolist()
        [True, True, True, False]
    """
    finite = np.flatnonzero(np.isfinite(times))
    with np.errstate(over="ignore"):
        far = np.abs(times[finite] - np.median(times[finite])) if len(finite) else times[finite]
        usual = np.median(np.abs(np.diff(times[finite]))) if len(finite) > 1 else np.inf
    finite = finite[far <= FARTHEST * usual]
    good = finite[increasing(times[finite])]
    steps = np.diff(times[good])
    if len(steps):
        good = np.concatenate([good[:1], good[1:][steps >= STILL * np.median(steps)]])
    out = np.zeros(len(times), bool)
    out[good] = True
    return out


def filled(times: np.ndarray, good: np.ndarray, step: float) -> np.ndarray:
    """Interpolates invalid times linearly between the valid ones, and extrapolates beyond these.

    Args:
        times: ``[N]``, at least one of them valid.
        good: mask of valid times, bool ``[N]``.
        step: time between two rows, for a single valid time.

    Examples:
        >>> filled(np.array([9.0, 1.0, 9.0, 3.0, 9.0]), np.array([False, True, False, True, False]), 1.0).tolist()
        [0.0, 1.0, 2.0, 3.0, 4.0]
    """
    index, places = np.arange(len(times)), np.flatnonzero(good)
    out = np.interp(index, places, times[places])
    step = float(np.median(np.diff(times[places]) / np.diff(places))) if len(places) > 1 else step
    out[: places[0]] -= step * (places[0] - index[: places[0]])
    out[places[-1] + 1 :] += step * (index[places[-1] + 1 :] - places[-1])
    return out


def increasing(times: np.ndarray) -> np.ndarray:
    """Masks the values of the longest strictly increasing sub-sequence, bool ``[N]``.

    A single outlier, too small or too large, is the only value left out; comparison with the running maximum would
    leave out all values after one that is too large. If both rules leave out equally many, the running maximum is used,
    unless its values span a longer time.

    Examples:
        >>> increasing(np.array([0.0, 1.0, 9.0, 2.0, 2.0, 3.0])).tolist()
        [True, True, False, True, False, True]
    """
    ends: list[float] = []  # the least end of an increasing sub-sequence, by its length
    last: list[int] = []  # index of that end
    before = np.full(len(times), -1)
    for index, value in enumerate(times.tolist()):
        length = bisect_left(ends, value)
        before[index] = last[length - 1] if length else -1
        if length == len(ends):
            ends.append(value)
            last.append(index)
        elif value < ends[length]:
            ends[length], last[length] = value, index
    keep = np.zeros(len(times), bool)
    index = last[-1] if last else -1
    while index >= 0:
        keep[index] = True
        index = int(before[index])
    ahead = np.ones(len(times), bool)
    ahead[1:] = times[1:] > np.maximum.accumulate(times)[:-1]
    as_many = ahead.sum() == keep.sum()
    return ahead if as_many and (not len(times) or np.ptp(times[ahead]) <= np.ptp(times[keep])) else keep


def row_times(streams: Mapping[str, np.ndarray], clock: str | float, span: Span = "common") -> np.ndarray:
    """Returns the times of the rows, s.

    Args:
        streams: times of each stream's readings, s, ascending.
        clock: stream whose times become the rows' times, or a rate in Hz.
        span: ``"common"`` for times after every stream has begun and before any has ended; ``"all"`` for all times of
            the clock; a rate runs from the first begin to the last end of a stream.

    Raises:
        ValueError: if the streams overlap by fewer than two rows, or by so many that the times cannot be in s.

    Examples:
        >>> streams = {"camera": np.array([0.0, 0.5, 1.0, 1.5]), "state": np.array([0.4, 1.1])}
        >>> row_times(streams, "camera"), row_times(streams, "camera", "all")
        (array([0.5, 1. ]), array([0. , 0.5, 1. , 1.5]))
        >>> row_times({"state": np.array([0.0, 0.9])}, 4.0)
        array([0.  , 0.25, 0.5 , 0.75])
    """
    begins, ends = ([times[at] for times in streams.values()] for at in (0, -1))
    begin, end = max(begins), min(ends)
    if span == "all" and begin <= end + SLACK:
        begin, end = min(begins), max(ends)
    rows = _between(begin, end, streams, clock)
    if len(rows) < 2:
        spans = ", ".join(f"{name} from {times[0]:.15g} to {times[-1]:.15g} s" for name, times in streams.items())
        raise ValueError(
            f"the streams have fewer than two rows in common: {spans}; their clocks must be the same: pass start= or "
            "times= for pictures, and unit= for tables whose times are not in s"
        )
    return rows


def _between(begin: float, end: float, streams: Mapping[str, np.ndarray], clock: str | float) -> np.ndarray:
    if end < begin:
        return np.zeros(0)
    if isinstance(clock, str):
        times = streams[clock]
        return times[(times >= begin - SLACK) & (times <= end + SLACK)]
    if (end - begin) * clock > MOST_ROWS:
        raise ValueError(
            f"{clock:g} rows per second from {begin:.15g} to {end:.15g} s are more than {MOST_ROWS:.0e}; pass a lower "
            "clock=, or unit= for tables whose times are not in s"
        )
    return begin + np.arange(int((end - begin + SLACK) * clock) + 1) / clock


def last_reading(
    times: np.ndarray, rows: np.ndarray, tolerance: float | None, taken: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns for each row the last reading that has arrived, and whether it arrived after the row before.

    Args:
        times: arrival times of the readings, s, ascending, ``[m]``.
        rows: times of the rows, s, ascending, ``[n]``.
        tolerance: s; an older reading counts as missing.
        taken: measurement times, s, ``[m]``; by default the arrival times.

    Returns:
        Index of the reading ``[n]``, -1 if there is none, and whether it is new, bool ``[n]``.

    Examples:
        >>> last_reading(np.array([0.0, 1.0]), np.array([0.0, 0.5, 1.0]), None)
        (array([0, 0, 1]), array([ True, False,  True]))
    """
    index = np.searchsorted(times, rows + SLACK, side="right") - 1
    if tolerance is not None:
        age = rows - (times if taken is None else taken)[index.clip(0)]
        index = np.where(age > tolerance + SLACK, -1, index)
    new = np.diff(index, prepend=-1) != 0
    return index, new & (index >= 0)


def rows_ago(taken: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Returns the latency of the reading in each row: the rows since the first row at or after its measurement.

    Args:
        taken: measurement times, s, ``[n]``.
        rows: times of the rows, s, ascending, ``[n]``; extrapolated for readings before the first row.

    Returns:
        int64 ``[n]``.

    Examples:
        >>> rows_ago(np.array([-0.5, 0.5, 0.4, 3.0]), np.arange(4.0))
        array([0, 0, 1, 0])
        >>> rows_ago(np.array([-3.5, -3.5]), np.arange(2.0))
        array([3, 4])
    """
    before = np.ceil((taken - rows[0] - SLACK) / np.median(np.diff(rows))).clip(max=0)
    return np.arange(len(rows)) - np.searchsorted(rows, taken - SLACK) - before.astype(np.int64)


def nearest_reading(times: np.ndarray, rows: np.ndarray, tolerance: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Returns for each row the reading nearest in time, before or after, and whether the row is nearest to it.

    Args:
        times: see :func:`last_reading`.
        rows: times of the rows, s, ascending, ``[n]``.
        tolerance: s; a reading farther away counts as missing. By default half the median time between two rows.

    Returns:
        As :func:`last_reading`: index, and whether the reading is observed in this row, which is True in one row only.

    Examples:
        >>> nearest_reading(np.array([0.1, 1.4]), np.array([0.0, 1.0, 2.0]), None)
        (array([ 0,  1, -1]), array([ True,  True, False]))
    """
    tolerance = 0.5 * float(np.median(np.diff(rows))) if tolerance is None else tolerance
    right = np.searchsorted(times, rows).clip(0, len(times) - 1)
    left = (right - 1).clip(0)
    index = np.where(rows - times[left] <= times[right] - rows, left, right)
    off = np.abs(times[index] - rows)
    there = off <= tolerance + SLACK
    order = np.lexsort((off, index))  # the nearest row of each reading comes first
    mine = np.zeros(len(rows), bool)
    mine[order] = np.diff(index[order], prepend=-1) != 0
    return np.where(there, index, -1), there & mine


def interpolate(
    times: np.ndarray, values: np.ndarray, rows: np.ndarray, tolerance: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolates linearly between the reading before a row and the one after it.

    Args:
        times: see :func:`last_reading`.
        values: of the readings, ``[m, C]``.
        rows: times of the rows, s, ascending, ``[n]``.
        tolerance: s; between readings that are farther apart there is no value.

    Returns:
        Values ``[n, C]``, zero if missing, and the mask of rows with a value, bool ``[n]``.

    Examples:
        >>> interpolate(np.array([0.0, 1.0]), np.array([[0.0], [2.0]]), np.array([0.25, 1.0]), None)
        (array([[0.5],
           [2. ]]), array([ True,  True]))
    """
    there = (rows >= times[0] - SLACK) & (rows <= times[-1] + SLACK)
    if tolerance is not None:
        right = np.searchsorted(times, rows - SLACK).clip(0, len(times) - 1)
        left = np.where(times[right] <= rows + SLACK, right, (right - 1).clip(0))
        there &= times[right] - times[left] <= tolerance + SLACK
    columns = [np.interp(rows, times, column) for column in values.T]
    return np.where(there[:, None], np.stack(columns, -1), 0.0), there
