"""Checks the times and values of a log, and warns of implausible ones.

All warnings have one form: the file or log, the column, what was seen, and the argument that cures it.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np
import torch

__all__ = [
    "LOOKS",
    "SECONDS",
    "Unit",
    "in_origin",
    "look_at_numbers",
    "look_at_repeats",
    "look_at_times",
    "repeats",
    "warn_of_log",
]

Unit = Literal["s", "ms", "us", "ns"]
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

_SLOWEST, _FASTEST = 5.0, 5e-5  # s: usual steps of sensors lie between
_LATEST = 1e11  # s: beyond is no time since 1970, before the year 5138
LOOKS = ("late", "back", "steps", "gaps")
_LONG, _STEPS = 60.0, 100  # a gap is longer than so many s, and than so many usual steps
_YEARS = 1e8  # s: a gap in any log
_BACK = 10  # usual steps, and one s, by which a stamp that is out of order goes back
_FEW = 0.02  # a share of stamps: if more go back, nobody has sorted them
_ENOUGH = 100  # steps from which on their distribution is judged
_TINY, _SHORT, _WIDE = 0.01, 0.05, 6.0  # mean steps: of bursts, there are many below the one, and some above the other
_RESOLVED = 20  # steps of a column have at least so many steps of its dtype
_NONE = 2 * np.finfo(np.float64).eps  # of a number: moves below are rounding
_READERS = ("torch_denkf", "torchrl", "tensordict")  # torchrl's data sets are made by a function of its own


def warn_of_log(place: object, column: str, seen: str, cure: str) -> None:
    """Warns of a column of a log; the warning points to the caller's line outside of the library."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _READERS:
        frame, level = frame.f_back, level + 1
    warnings.warn(f"{place}: {column!r} {seen}; {cure}", stacklevel=level)


def look_at_times(
    times: np.ndarray, place: object, column: str, unit: str | None = "s", looks: Collection[str] = LOOKS
) -> None:
    """Warns of times in a wrong unit, out of order, with gaps as of another clock, or in bursts.

    Args:
        times: s, ``[n]``, in the order of the log; it may be a random one.
        place: the file or log.
        column: the column of the times, or the sensor.
        unit: in which they were read; None where that cannot be said, but they are in s.
        looks: some of :data:`LOOKS`.

    Examples:
        >>> with warnings.catch_warnings(record=True) as said:
        ...     look_at_times(np.arange(5) * 1e7, "run1.csv", "t")
        >>> print(said[0].message)
        run1.csv: 't' has steps of usually 1e+07 s; if the times are not in 's', pass unit='ms', 'us' or 'ns'
    """
    moments = np.unique(times)
    found = {"late": _late(moments), "back": _backwards(times), "steps": _stepping(moments), "gaps": _gap(moments)}
    if found["steps"] is not None:
        found["gaps"] = None  # the same, seen again
    faults = [fault for look, fault in found.items() if fault is not None and look in looks]
    if not faults:
        return
    others = ", ".join(repr(name) for name in SECONDS if name != unit)
    passed = "write them in s" if unit is None else f"pass unit={' or '.join(others.rsplit(', ', 1))}"
    cures = [f"if the times are not in {unit or 's'!r}, {passed}"]
    cures += [cure for _, cure in faults if cure]
    warn_of_log(place, column, ", and ".join(seen for seen, _ in faults), "; ".join(cures))


def _late(moments: np.ndarray) -> tuple[str, str] | None:
    latest = np.abs(moments).max(initial=0.0)
    return (f"has times up to {latest:.3g} s, later than any since 1970", "") if latest > _LATEST else None


def _backwards(times: np.ndarray) -> tuple[str, str] | None:
    """Tells where few times go back by much; where many do, the log is in no order, or by another one."""
    steps = np.diff(times)
    back = -steps[steps < 0]
    if not len(back) or len(steps) < 3 or len(back) > max(1, _FEW * len(steps)):
        return None
    if back.max() <= max(_BACK * np.median(np.abs(steps)), 1.0):
        return None
    at = int(steps.argmin()) + 1
    seen = f"goes back by {back.max():.4g} s, to {times[at]:.15g} s, at {at} of {len(times)} (from 0)"
    return seen, "keep runs apart, and leave out what has another clock"


def _stepping(moments: np.ndarray) -> tuple[str, str] | None:
    """Judges the distribution of the steps between ascending times."""
    steps = np.diff(moments)
    usual = float(np.median(steps)) if len(steps) > 3 else 1.0
    if not _FASTEST <= usual <= _SLOWEST:
        return f"has steps of usually {usual:.3g} s", ""
    if len(steps) < _ENOUGH:
        return None
    mean = float(np.sort(steps)[: int(0.99 * len(steps))].mean())
    # Of events that come at random, 1 % of the steps are below _TINY, 5 % below _SHORT, and 0.2 % above _WIDE.
    tiny, short, wide = (
        float(part.mean()) for part in (steps < _TINY * mean, steps < _SHORT * mean, steps > _WIDE * mean)
    )
    if tiny < 0.03 and short < 0.2 and (short < 0.02 or wide < 0.005):
        return None
    seen = (
        f"comes in bursts: {short:.1%} of the steps are below {_SHORT * mean:.2g} s, {wide:.1%} above "
        f"{_WIDE * mean:.2g} s, where they are {mean:.2g} s on average"
    )
    return seen, "take the times of the measurements, not those of their arrival"


def _gap(moments: np.ndarray) -> tuple[str, str] | None:
    steps = np.diff(moments)
    usual = float(np.median(steps)) if len(steps) > 2 else _YEARS / _STEPS
    longest = steps.max(initial=0.0)
    if longest <= max(_LONG, min(_STEPS * usual, _YEARS)):
        return None
    seen = f"has nothing for {longest:.4g} s after {moments[steps.argmax()]:.15g} s" + (
        f", where steps are usually {usual:.3g} s" if len(steps) > 2 else ""
    )
    return seen, "keep runs apart, and leave out times that were never set"


def look_at_numbers(
    values: np.ndarray, columns: Sequence[str], place: object, cure: str = "", dtype: torch.dtype = torch.float32
) -> bool:
    """Warns of columns whose steps the output dtype does not resolve.

    Args:
        values: ``[n, C]``, float64.
        columns: their names ``[C]``.
        place: the file or log.
        cure: what to pass; by default ``origin=`` of a table.
        dtype: of what is handed out.

    Returns:
        Whether there are any.

    Examples:
        >>> with warnings.catch_warnings(record=True) as said:
        ...     _ = look_at_numbers(5.4e6 + 0.02 * np.arange(201.0)[:, None], ["north"], "run1.csv")
        >>> print(said[0].message)
        run1.csv: 'north' moves by 0.02 a row near 5400002, where float32 resolves 0.5; pass origin={'north': 5400002.0}
    """
    found = []
    for column, name in zip(values.T, columns, strict=True):
        column = column[np.isfinite(column)]
        moves = np.abs(np.diff(column))
        moves = moves[moves > _NONE * np.abs(column).max(initial=0.0)]
        if not len(moves):
            continue
        tensor = torch.from_numpy(np.ascontiguousarray(column))
        size = np.quantile(np.abs(column[column != 0]), 0.9)  # an outlier is no reason to move the others
        resolved = torch.finfo(dtype).eps * 2.0 ** np.floor(np.log2(size))
        step = float(np.median(moves))
        if _RESOLVED * resolved > step and bool((tensor.to(dtype).double() != tensor).any()):
            middle = float(np.median(column))
            digits = -int(np.floor(np.log10(max(np.ptp(column), step))))
            found.append((name, step, middle, resolved, round(middle, digits)))
    if not found:
        return False
    what = str(dtype).removeprefix("torch.")
    texts = [
        f"moves by {step:.3g} a row near {middle:.10g}, where {what} resolves {least:.2g}"
        for _, step, middle, least, _ in found
    ]
    origins = ", ".join(f"{name!r}: {origin}" for name, *_, origin in found)
    seen = ", ".join([texts[0], *(f"{one[0]!r} {text}" for one, text in zip(found[1:], texts[1:], strict=True))])
    warn_of_log(place, found[0][0], seen, cure or f"pass origin={{{origins}}}")
    return True


def look_at_repeats(values: np.ndarray, columns: Sequence[str], place: object) -> None:
    """Warns of columns that repeat their last reading until the next one arrives.

    A column that moves by its smallest step most of the time is one of coarse numbers, such as a temperature or an
    encoder's ticks, and its rows are readings.

    Args:
        values: ``[n, C]``.
        columns: their names ``[C]``.
        place: the file.

    Examples:
        >>> fixes = np.array([0.0, 3.0, 7.0, 8.0, 12.0, 20.0]).repeat(5)[:, None]
        >>> with warnings.catch_warnings(record=True) as said:
        ...     look_at_repeats(fixes, ["north"], "run1.csv")
        >>> print(str(said[0].message)[:75])
        run1.csv: 'north' repeats its last reading in 80 % of the rows, and each ro
    """
    slow = [name for column, name in zip(values.T, columns, strict=True) if repeats(column)]
    if not slow:
        return
    kept = 1 + int((np.diff(values[:, [name in slow for name in columns]], axis=0) != 0).any(1).sum())
    if len(slow) == len(columns):
        cure = "pass repeats='drop'"
    else:
        cure = f"read it with repeats='drop' in a Table of its own, columns={slow}"
    warn_of_log(
        place,
        slow[0],
        f"repeats its last reading in {100 * (1 - kept / len(values)):.0f} % of the rows"
        + (f", with {slow[1:]}" if slow[1:] else "")
        + ", and each row counts as a new one",
        f"{cure}, or repeats='keep' if the sensor has read in each",
    )


def repeats(column: np.ndarray) -> bool:
    """Returns True if a column repeats its last reading until the next one arrives."""
    moves = np.diff(column)
    changes = np.flatnonzero(moves)
    if len(changes) < 5 or np.median(np.diff(changes)) < 2:
        return False
    sizes = np.abs(moves[changes])
    return bool(np.median(sizes) > 1.5 * sizes.min())


def in_origin(values: np.ndarray, origin: object, place: str) -> np.ndarray:
    """Subtracts an origin in float64, before the conversion to a shorter dtype.

    Args:
        values: ``[n, C]``.
        origin: a number, or ``C`` of them.
        place: names the argument, for the message.

    Raises:
        ValueError: if they are not as many as the columns, or not finite.

    Examples:
        >>> in_origin(np.array([[5.4e6 + 0.02, 1.0]]), [5.4e6, 0.0], "origin").round(3)
        array([[0.02, 1.  ]])
    """
    try:
        given = np.asarray(origin, np.float64)
    except (TypeError, ValueError):
        given = np.array(np.nan)
    if given.shape not in ((), (1,), values.shape[-1:]) or not np.isfinite(given).all():
        raise ValueError(f"{place} must be a finite number, or {values.shape[-1]} of them; got {origin!r}")
    return values - given
