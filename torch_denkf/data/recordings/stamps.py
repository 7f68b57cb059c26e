"""Time stamps of a log: finds their column and unit, and converts dates and pairs of numbers to seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date

import numpy as np

from torch_denkf.diagnosis.logs import Unit

__all__ = ["DATE_AND_TIME", "nanoseconds_beside", "seconds_of", "time_columns", "unit_of"]

_DAY, _CLOCK = r"\d{4}[-/.]\d\d?[-/.]\d\d?", r"\d\d?:\d\d(?::\d\d(?:\.\d*)?)?"
DATE_AND_TIME = re.compile(rf"({_DAY}) +({_CLOCK})")
_STAMP = re.compile(rf"\s*(?:({_DAY})(?:[T ,_-]+|$))?(?:({_CLOCK})\s*(Z|UTC|[+-]\d\d:?\d\d)?)?\s*$")
_UNITS: dict[str, Unit] = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "usec", "usecs", "micros", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanoseconds"), "ns"),
}
#: Names of columns of times, the best first: the time of measurement comes before the time of recording.
_NAMES = (
    r".*header[._/ ]?stamp([._/ ]?secs?)?",
    r"time",
    r"(time|timestamp|stamp|times|t|epoch|utc|unix|date|datetime)([._ -]*(utc|unix|epoch|stamp|time|{units}))?",
    r"(?!s$)({units})|rosbagtimestamp",
)
_SINCE_1970: dict[Unit, float] = {"ns": 1e17, "us": 1e14, "ms": 1e11}  # smallest stamp of each unit: 1973


def time_columns(names: Sequence[str]) -> list[str]:
    """Lists the columns that may hold the times, the likeliest first.

    Examples:
        >>> time_columns(["rosbagTimestamp", "x", ".header.stamp.secs", "Time"])
        ['.header.stamp.secs', 'Time', 'rosbagTimestamp']
    """
    patterns = [pattern.replace("{units}", "|".join(_UNITS)) for pattern in _NAMES]
    ranks = {}
    for name in names:
        plain = re.sub(r"[\[(].*", "", name).strip(" %#").lower()
        rank = next((rank for rank, pattern in enumerate(patterns) if re.fullmatch(pattern, plain)), None)
        if rank is not None and not re.search(r"n(ano)?sec", plain.rpartition(".")[2]):
            ranks[name] = rank
    return sorted(ranks, key=ranks.__getitem__)


def nanoseconds_beside(time: str, names: Sequence[str]) -> str | None:
    """Returns the column with the nanoseconds of a column of whole seconds, as ROS writes stamps.

    Examples:
        >>> nanoseconds_beside("header.stamp.secs", ["x", "header.stamp.nsecs"])
        'header.stamp.nsecs'
    """
    if not (stem := re.fullmatch(r"(.*?)(secs?|seconds)", time, re.IGNORECASE)):
        return None
    wanted = re.compile(re.escape(stem[1]) + r"(nsecs?|nanosecs?|nanoseconds|nanos)", re.IGNORECASE)
    return next((name for name in names if wanted.fullmatch(name)), None)


def seconds_of(text: str) -> float | None:
    """Converts a date, a time of day, or both to s, since 1970 in UTC if there is a date; ``None`` for other text.

    Examples:
        >>> seconds_of("2014-03-26T15:10:23.825Z"), seconds_of("0:01:02.5"), seconds_of("12.5")
        (1395846623.825, 62.5, None)
    """
    found = _STAMP.match(text)
    if not found or not (found[1] or found[2]):
        return None
    total = 0.0
    if found[1]:
        year, month, day = map(int, re.split(r"[-/.]", found[1]))
        try:
            total = 86400.0 * (date(year, month, day).toordinal() - date(1970, 1, 1).toordinal())
        except ValueError:
            return None
    for part, worth in zip((found[2] or "").split(":"), (3600.0, 60.0, 1.0), strict=False):
        total += worth * float(part or 0)
    if found[3] and found[3][0] in "+-":
        hours, minutes = found[3][1:3], found[3][-2:]
        total -= float(found[3][0] + "1") * (3600.0 * int(hours) + 60.0 * int(minutes))
    return total


def unit_of(name: str, times: np.ndarray) -> Unit:
    """Returns the unit of times, by the name of their column, or by the size of stamps since 1970.

    Examples:
        >>> unit_of("timestamp [ns]", np.zeros(1)), unit_of("time", np.array([1.4e15])), unit_of("t", np.zeros(1))
        ('ns', 'us', 's')
    """
    words = re.findall(r"[^\W\d_]+", name.lower())
    for word in reversed(words):
        if word in _UNITS and (word != "s" or len(words) > 1):  # a column "s" may be a distance
            return _UNITS[word]
    size = float(np.median(np.abs(times[np.isfinite(times)]))) if np.isfinite(times).any() else 0.0
    return next((unit for unit, least in _SINCE_1970.items() if size > least), "s")
