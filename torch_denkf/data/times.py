"""Times of a recording: which of them are sound, values for the others, and which reading belongs to which row."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import Literal

import numpy as np

Way = Literal["last", "nearest", "linear"]
Span = Literal["common", "all"]
STILL = 0.1  # a step that is shorter, in median steps, is none: the stamp was written twice
FARTHEST = 1e9  # median steps from the other stamps, beyond which a stamp is none: years, at a camera's rate
MOST_WRONG = 0.1  # a share of times that are wrong, up to which the others are trusted
SLACK = 1e-6  # s: times that differ by less are the same
MOST_ROWS = 10**8  # of one recording: eleven days at 100 Hz


def sound(times: np.ndarray) -> np.ndarray:
    """Masks stamps that are finite and increase, neither by next to nothing nor beyond any clock, bool ``[N]``.

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
    """Interpolates invalid times on straight lines between the others, and extrapolates beyond these.

    Args:
        times: ``[N]``, of which one at least is sound.
        good: which are, bool ``[N]``.
        step: between two rows, where only one is.

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

    One value that is too small, or too large, is the only one left out; a rule that compares with what came before
    would leave out all that follow a value that is too large. Where both leave out as many, it is the later ones,
    unless that makes the whole longer.

    Examples:
        >>> increasing(np.array([0.0, 1.0, 9.0, 2.0, 2.0, 3.0])).tolist()
        [True, True, False, True, False, True]
    """
    ends: list[float] = []  # the least end of an increasing sub-sequence, by its length
    last: list[int] = []  # where that end is
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
    """Returns times of the rows, in s.

    Args:
        streams: times of each stream's readings, s, ascending.
        clock: the stream whose times are the rows', or a rate in Hz.
        span: ``"common"`` for those at which every stream has begun and none has ended; ``"all"`` for all times of the
            clock, which a rate has from the first begin to the last end of a stream.

    Raises:
        ValueError: if the streams do not overlap by two rows, or by so many that the times cannot be in s.

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
    """Returns for each row the last reading that arrived by then, and whether it arrived since the row before.

    Args:
        times: when the readings arrived, s, ascending, ``[m]``.
        rows: times of the rows, s, ascending, ``[n]``.
        tolerance: s; an older reading is none.
        taken: when the readings were taken, s, ``[m]``; by default they arrive at once.

    Returns:
        Its index ``[n]``, -1 if there is none, and whether it is new, bool ``[n]``.

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
    """Returns the latency of the reading in each row: the rows since the first one at, or after, it was taken.

    Args:
        taken: s, ``[n]``.
        rows: times of the rows that show it, s, ascending, ``[n]``. Where a reading was taken before the first, the
            rows are thought to go on there.

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
    """Returns for each row the nearest reading in time, also a later one, and whether the row is its nearest, too.

    Args:
        times: see :func:`last_reading`.
        rows: times of the rows, in s, ``[n]``, rising.
        tolerance: s; a reading farther away is none. By default half the usual time between two rows.

    Returns:
        As :func:`last_reading`: index and whether the reading is seen here; in no other row, then.

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
    order = np.lexsort((off, index))  # of the rows that share a reading, the nearest comes first
    mine = np.zeros(len(rows), bool)
    mine[order] = np.diff(index[order], prepend=-1) != 0
    return np.where(there, index, -1), there & mine


def interpolate(
    times: np.ndarray, values: np.ndarray, rows: np.ndarray, tolerance: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolates on a straight line between the reading before a row and the one after it.

    Args:
        times: see :func:`last_reading`.
        values: of the readings, ``[m, C]``.
        rows: times of the rows, in s, ``[n]``, rising.
        tolerance: s; between readings that are farther apart there is no value.

    Returns:
        Values ``[n, C]``, zero if there is none, and where there is one, bool ``[n]``.

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
