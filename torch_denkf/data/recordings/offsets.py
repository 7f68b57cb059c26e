"""Estimates delays between the streams of a log from quantities that two streams have in common."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from torch_denkf.data.recordings.outliers import fixes_of, outlying
from torch_denkf.data.recordings.quantities import find, in_radians, quantity
from torch_denkf.data.recordings.replay import Recording
from torch_denkf.data.recordings.tables import Readings, Table, changes
from torch_denkf.diagnosis.logs import repeats

__all__ = ["ClockOffset", "Delay", "changes_of", "clock_offsets", "delays_between", "solved"]

_SPANS = (1.0, 2.0)  # s: intervals of the compared changes; longer ones average more noise
_STEP = 0.02  # s: step of the search
_LEAST = 30  # fewest comparisons
_AGREE = 0.6  # smallest correlation of two streams with a common quantity
_NOISY = 0.9  # correlation below which the noise of fixes is much of a short way, as of slow robots
_BLOCK = 4.0  # spans, after which errors are taken to be independent
_BETTER = 0.7  # ratio of standard deviations below which the longer span is preferred
_STEADY = 0.02  # relative variation below which a signal counts as constant


class ClockOffset(NamedTuple):
    """Correction of a stream's clock.

    Attributes:
        seconds: value for the table's ``offset``; zero for the reference stream.
        std: its standard deviation, s.
    """

    seconds: float
    std: float

    @property
    def sure(self) -> bool:
        """Returns True beyond three standard deviations: of some streams one is soon beyond two by chance."""
        return abs(self.seconds) > 3 * self.std


class Delay(NamedTuple):
    """Delay of one stream relative to another, from one common quantity.

    Attributes:
        late: the stream that is later, if ``seconds`` is positive.
        early: the other one.
        what: common quantity, ``"heading"`` or ``"way"`` (distance travelled).
        seconds: the delay.
        std: its standard deviation, s.
        scale: ratio of the quantity in ``late`` to that in ``early``.
        correlation: correlation of the two streams at that delay.
    """

    late: str
    early: str
    what: str
    seconds: float
    std: float
    scale: float
    correlation: float


class _Signal(NamedTuple):
    """Quantity of a stream: times ``[n]``, a heading or distance ``[n]`` or fixes ``[n, 2]``, and weights ``[n]``."""

    times: np.ndarray
    level: np.ndarray
    weight: np.ndarray


def clock_offsets(recording: Recording, *, most: float = 5.0) -> dict[str, ClockOffset]:
    """Estimates clock offsets between a recording's streams from quantities that two streams have in common.

    Turn rates, headings and the directions between fixes are compared, and so are speeds and the distances between
    fixes. Columns are recognised by usual names, such as ``yawrate``, ``course``, ``speed``, ``x``, ``latitude`` and
    ``twist.twist.linear.x``; units do not matter. The robot must turn, or change its speed, several times.

    Args:
        recording: recording whose tables are compared.
        most: s, the largest delay between two streams.

    Returns:
        By stream name, for streams with a common quantity: offset to add to their times, relative to the stream of turn
        rates with the highest rate.

    Raises:
        ValueError: if no two streams have a common quantity.

    Examples:
        >>> from tempfile import mkdtemp
        >>> from pathlib import Path
        >>> t, folder = np.arange(0, 60, 0.05), Path(mkdtemp())
        >>> rate = np.sin(t) + np.sin(0.37 * t)
        >>> np.savetxt(folder / "gyro.txt", np.c_[t, rate], header="time yaw_rate")
        >>> np.savetxt(folder / "gps.txt", np.c_[t + 0.4, -np.cos(t) - np.cos(0.37 * t) / 0.37], header="time course")
        >>> run = Recording(gyro=Table(folder / "gyro.txt"), gps=Table(folder / "gps.txt"))
        >>> round(clock_offsets(run)["gps"].seconds, 2)
        -0.4
    """
    streams = {name: stream for name, stream in recording.streams.items() if isinstance(stream, Table)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of float32, which is not used here
        tables = {name: replace(stream, origin=None).read() for name, stream in streams.items()}
    delays = delays_between(tables, most)
    if not delays:
        raise ValueError(
            f"recording {recording.name!r}: no two of {list(tables)} know the same turns or ways; give columns usual "
            "names by a header, or pass the offset= that you know"
        )
    return solved(delays, tables)


def solved(delays: Sequence[Delay], tables: Mapping[str, Readings]) -> dict[str, ClockOffset]:
    """Computes offsets from delays of pairs by least squares, relative to the fastest stream of turn rates."""
    linked = {name: tables[name] for delay in delays for name in (delay.late, delay.early)}
    turning = [name for name, table in linked.items() if find(table.columns, "turn rate")] or list(linked)
    first = min(turning, key=lambda name: float(np.median(np.diff(linked[name].times))))
    names = [first]
    for _ in delays:
        names += [
            other
            for delay in delays
            for one, other in ((delay.late, delay.early), (delay.early, delay.late))
            if one in names and other not in names
        ][:1]
    place = {name: number for number, name in enumerate(names)}
    used = [delay for delay in delays if delay.late in place]
    design = np.zeros((len(used), len(names)))
    for row, delay in enumerate(used):
        design[row, place[delay.late]], design[row, place[delay.early]] = -1.0, 1.0
    weights = np.array([delay.std for delay in used])[:, None] ** -2
    cov = np.linalg.inv(design[:, 1:].T @ (weights * design[:, 1:]))
    found = cov @ design[:, 1:].T @ (weights[:, 0] * np.array([delay.seconds for delay in used]))
    offsets = [ClockOffset(0.0, 0.0), *map(ClockOffset, found.tolist(), np.sqrt(np.diag(cov)).tolist())]
    return dict(zip(names, offsets, strict=True))


def delays_between(tables: Mapping[str, Readings], most: float = 5.0) -> list[Delay]:
    """Compares all pairs of streams.

    Args:
        tables: readings by the names of streams.
        most: s, the largest delay.

    Returns:
        Delays of the pairs that have a common quantity.
    """
    known = {name: _signals(table) for name, table in tables.items()}
    out = []
    for one, other in combinations(known, 2):
        for what in known[one].keys() & known[other].keys():
            early, late = sorted((one, other), key=lambda name: (known[name][what].level.ndim, len(tables[name].times)))
            if known[early][what].level.ndim == 1 and known[late][what].level.ndim == 1:
                early, late = late, early  # the comparison is at the times of the slower one
            if known[early][what].level.ndim == 1:
                # Large shifts leave out the ends of a log, where a robot starts to move; smaller limits keep them.
                pair = known[early][what], known[late][what]
                tried = [_delay(*pair, what, limit, _SPANS[0]) for limit in (most, most / 3, most / 9)]
                sizes = [0.0 if one is None else abs(one[3]) for one in tried]
                best = int(np.argmax(sizes))
                limit = most / 3**best
                found = tried[best]
                # Chords of curves are shorter than the way, which matters less than much noise.
                if what == "heading" or pair[1].level.ndim == 1 or sizes[best] < _NOISY:
                    longer = _delay(*pair, what, limit, _SPANS[1])
                    if found is not None and longer is not None:
                        # The variance includes the part of the difference between both spans that their variances do
                        # not explain.
                        apart = (found[0] - longer[0]) ** 2 - max(found[1], longer[1]) ** 2
                        found = longer if longer[1] < _BETTER * found[1] else found
                        found = (found[0], float(np.sqrt(found[1] ** 2 + max(apart, 0.0) / 4)), *found[2:])
                    found = longer if found is None else found
                if found is not None and abs(found[3]) >= _AGREE:
                    out.append(Delay(late, early, what, *found))
    return out


def changes_of(tables: Mapping[str, Readings], offsets: Mapping[str, float]) -> tuple[dict, dict]:
    """Returns corrected times of the streams, and the changes of heading and distance that several streams measure.

    Args:
        tables: readings by stream.
        offsets: to add to their times.

    Returns:
        Times by stream; and by title, times and values of each stream, of size 1.
    """
    begin = min(table.times[0] for table in tables.values())
    steps, changes = {name: table.times - begin for name, table in tables.items()}, {}
    known = {name: _signals(table) for name, table in tables.items()}
    for what, title in (("heading", "turn rate, scaled"), ("way", "speed, scaled")):
        drawn: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for name in known:
            if what in known[name]:
                times, level, _ = known[name][what]
                at = np.arange(times[0], times[-1] - 1.0, 0.1)
                if level.ndim > 1:
                    x, y = (np.interp([at, at + 1.0], times, column) for column in level.T)
                    dx, dy = x[1] - x[0], y[1] - y[0]
                    value = np.hypot(dx, dy) if what == "way" else np.gradient(np.unwrap(np.arctan2(dy, dx)), at)
                else:
                    value = np.interp(at + 1.0, times, level) - np.interp(at, times, level)
                scale = np.quantile(np.abs(value), 0.95) if len(value) else 0.0
                at, value = at + 0.5 - begin + offsets.get(name, 0.0), value / (scale or 1.0)
                other = np.interp(at, *next(iter(drawn.values()))) if drawn else value
                drawn[name] = at, value * (1.0 if (value * other).sum() >= 0 else -1.0)  # sign: clockwise in some logs
        if len(drawn) > 1:
            changes[title] = drawn
    return steps, changes


def _signals(table: Readings) -> dict[str, _Signal]:
    """Returns the headings and distances that a stream measures."""
    columns, times, values = table.columns, table.times, table.values
    known = [place for place, name in enumerate(columns) if quantity(name)]
    if any(repeats(values[:, place]) for place in known):
        new = changes(values[:, known])
        times, values = times[new], values[new]
    ones, out = np.ones(len(times)), {}
    speed = find(columns, "speed")
    fixes = fixes_of(columns, values)
    if fixes is not None:
        sound = ~outlying(times, fixes)
        out["heading"] = out["way"] = _Signal(times[sound], fixes[sound], ones[sound])
    if speed:
        out["way"] = _Signal(times, _integral(times, values[:, speed[0]]), ones)
    if heading := find(columns, "heading"):
        weight = ones if speed is None else np.square(values[:, speed[0]])
        out["heading"] = _Signal(times, np.unwrap(in_radians(columns[heading[0]], values[:, heading[0]])), weight)
    if turn := find(columns, "turn rate"):
        out["heading"] = _Signal(times, _integral(times, values[:, turn[0]]), ones)
    return out


def _integral(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.append(0.0, np.cumsum(np.diff(times) * (values[1:] + values[:-1]) / 2))


def _delay(
    early: _Signal, late: _Signal, what: str, most: float, span: float
) -> tuple[float, float, float, float] | None:
    """Returns delay, its standard deviation, scale and correlation; ``None`` if the overlap or variation is too small.

    The changes of the late stream over a span are compared with those of the early one over the same span, shifted.
    """
    most = min(most, (early.times[-1] - early.times[0]) / 4)
    end = np.searchsorted(late.times, late.times + span - 1e-6)
    fixes = late.level.ndim == 2
    corners = fixes and what == "heading"
    last = np.append(end, len(end))[end] if corners else end  # one span after the end
    until = np.append(late.times, np.inf)[last]
    begin = np.flatnonzero((late.times > early.times[0] + most) & (until < early.times[-1] - most))
    took = until[begin] - late.times[begin]
    begin = begin[took < 2 * np.median(took)] if len(begin) else begin  # across a gap a chord is shorter than a way
    end, last = end[begin], last[begin]
    if len(begin) < _LEAST:
        return None
    way = late.level[end] - late.level[begin]
    if corners:
        then, level = late.level[last] - late.level[end], _integral(early.times, early.level)
        change = np.arctan2(way[:, 0] * then[:, 1] - way[:, 1] * then[:, 0], (way * then).sum(1))
        weight = np.minimum(np.square(way).sum(1), np.square(then).sum(1))
    else:
        change, level = np.linalg.norm(way, axis=-1) if fixes else way, early.level
        weight = np.minimum(late.weight[begin], late.weight[end])

    def model(shift: float) -> np.ndarray:
        at = [np.interp(late.times[which] - shift, early.times, level) for which in (begin, end, last)]
        first, second = at[1] - at[0], at[2] - at[1]
        if not corners:
            return first
        return second / (late.times[last] - late.times[end]) - first / (late.times[end] - late.times[begin])

    def centred(values: np.ndarray) -> np.ndarray:
        return values - np.average(values, weights=weight)

    def fit(shift: float) -> tuple[np.ndarray, float, float]:
        x, y = centred(model(shift)), centred(change)
        xx, xy, yy = ((weight * product).sum() for product in (x * x, x * y, y * y))
        return x, float(xy / xx) if xx > 0 else 0.0, float(xy / np.sqrt(xx * yy)) if xx * yy > 0 else 0.0

    if not (weight > 0).any() or np.std(model(0.0)) < _STEADY * np.abs(model(0.0)).max():
        return None
    shifts = np.arange(-most, most + _STEP, _STEP)
    fits = [fit(shift)[2] for shift in shifts]
    found = int(np.abs(fits).argmax())
    if not 0 < found < len(shifts) - 1:
        return None
    left, best, right = np.square(fits[found - 1 : found + 2])
    shift = float(shifts[found] + _STEP * 0.5 * (left - right) / (left - 2 * best + right))
    x, scale, correlation = fit(shift)
    slope = centred(-scale * (model(shift + _STEP) - model(shift - _STEP)) / (2 * _STEP))
    slope -= x * (weight * x * slope).sum() / (weight * x * x).sum()
    score = weight * slope * (centred(change) - scale * x)
    # Errors are correlated in time: the variance is a jackknife over blocks of several spans.
    block = ((late.times[begin] - late.times[begin[0]]) // max(_BLOCK * span, 8.0)).astype(int)
    sums, known = np.bincount(block, score), np.bincount(block, weight * slope * slope)
    blocks = max(2.0, float(known.sum() ** 2 / np.square(known).sum()))  # effective number of blocks
    with np.errstate(over="ignore"):  # with a single block the variance is infinite
        variance = np.square(sums / (known.sum() - known).clip(min=1e-300)).sum()
    variance = variance * (1 + 1.2 / (blocks - 1)) ** 2 + np.median(np.diff(early.times)) ** 2 / 12
    return shift, float(np.sqrt(variance)), scale, correlation
