"""The times of a drive's frames, also where some of them are wrong: which are sound, and how far frames are apart."""

from __future__ import annotations

import warnings
from bisect import bisect_left
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torch_denkf._checks import read_lines
from torch_denkf.vision.poses import KITTI_DT

__all__ = ["GAP", "Times", "increasing", "read_times"]

GAP = 1.5  # a step that is longer, in median steps, is a gap: no image pair reaches over it
STILL = 0.1  # a step that is shorter, in median steps, is none: the stamp was written twice
SHORTEST, LONGEST = 1e-5, 1e4  # s between frames: beyond, the times are not in seconds
MOST_WRONG = 0.1  # a share of times that do not increase, up to which the others are trusted


class Times(NamedTuple):
    """When a drive's frames were taken.

    Attributes:
        times: s, increasing, ``[N]``; where a stamp is wrong, a value between its neighbours.
        dt: s since the frame before, ``[N]``: the median in all rows but those after a gap. The first row has the
            median, too.
        sound: whether the stamp of the file is right, bool ``[N]``.
        median: s, the frame time.
    """

    times: np.ndarray
    dt: np.ndarray
    sound: np.ndarray
    median: float


def read_times(file: Path, rows: int) -> Times:
    """Read the frames' times, or make nominal ones where there is no file.

    A warning counts the stamps that do not increase, which are not used, and the gaps.

    Args:
        file: ``sequences/NN/times.txt``.
        rows: how many frames need a time.

    Returns:
        The times of the first ``rows`` frames. Their median is over all rows of the file, 0.103 s where there is none.

    Raises:
        ValueError: naming file and line, if the file has fewer rows, if a row is no finite number, if more than a
            tenth of its times do not increase, or if they cannot be in seconds.
    """
    if not file.is_file():
        return Times(KITTI_DT * np.arange(rows), np.full(rows, KITTI_DT), np.ones(rows, bool), KITTI_DT)
    lines = read_lines(file)
    while lines and not lines[-1].strip():
        lines.pop()
    if len(lines) < rows:
        raise ValueError(f"{file} has {len(lines)} times, but there are {rows} posed frames; add the missing rows")
    times = np.array([_seconds(file, number, line) for number, line in enumerate(lines, start=1)])
    sound = _sound(times)
    wrong = np.flatnonzero(~sound)
    if len(wrong) > MOST_WRONG * len(times):
        raise ValueError(
            f"{file}:{wrong[0] + 1}: the time {times[wrong[0]]:g} s does not increase, nor do {len(wrong) - 1} others "
            f"of {len(times)}; expected increasing seconds, one a frame: write them anew, or take the file away "
            f"(frames are then {KITTI_DT} s apart)"
        )
    if len(wrong):
        warnings.warn(
            f"{file}: {len(wrong)} of {len(times)} times do not increase, the first in line {wrong[0] + 1} "
            f"({times[wrong[0]]:g} s); their frames count as missing (frame_valid False)",
            stacklevel=5,
        )
        times = _filled(times, sound)
    return _with_steps(file, times, sound, rows)


def _seconds(file: Path, number: int, line: str) -> float:
    try:
        (word,) = line.split()
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        words = len(line.split())
        raise ValueError(f"{file}:{number}: expected 1 finite number (seconds), got {words} words: {line[:60]!r}")
    return value


def _filled(times: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """The times with those that are not sound on straight lines between the others, and beyond these."""
    index, good = np.arange(len(times)), np.flatnonzero(sound)
    filled = np.interp(index, good, times[good])
    step = np.median(np.diff(times[good]) / np.diff(good)) if len(good) > 1 else KITTI_DT
    filled[: good[0]] -= step * (good[0] - index[: good[0]])
    filled[good[-1] + 1 :] += step * (index[good[-1] + 1 :] - good[-1])
    return filled


def _with_steps(file: Path, times: np.ndarray, sound: np.ndarray, rows: int) -> Times:
    if len(times) < 2:
        return Times(times, np.full(len(times), KITTI_DT), sound, KITTI_DT)
    steps = np.diff(times)
    median = float(np.median(steps))
    if not SHORTEST <= median <= LONGEST:
        raise ValueError(
            f"{file}: the median difference of its times is {median:g} s, expected {SHORTEST:g} to {LONGEST:g}; write "
            "the times in seconds"
        )
    # Clocks jitter, and images come at a steady rate all the same: a step counts with its own length where that cannot
    # be jitter.
    own = np.concatenate([[median], steps])
    dt = np.where((own > GAP * median) | (own < median / GAP), own, median)
    dt[0] = median
    gaps = np.flatnonzero(dt[:rows] > GAP * median)
    if len(gaps):
        longest = gaps[dt[gaps].argmax()]
        warnings.warn(
            f"{file}: {len(gaps)} gaps, the longest of {dt[longest]:g} s before line {longest + 1}, where frames come "
            f"each {median:g} s; speeds there are means over the gap, and no image pair reaches over it",
            stacklevel=6,
        )
    return Times(times[:rows], dt[:rows], sound[:rows], median)


def _sound(times: np.ndarray) -> np.ndarray:
    """Stamps that increase, and not by next to nothing."""
    sound = increasing(times)
    good = np.flatnonzero(sound)
    steps = np.diff(times[good])
    if len(steps):
        sound[good[1:][steps < STILL * np.median(steps)]] = False
    return sound


def increasing(times: np.ndarray) -> np.ndarray:
    """Which values belong to the longest strictly increasing sub-sequence, bool ``[N]``.

    One value that is too small, or too large, is the only one left out; a rule that compares with what came before
    would leave out all that follow a value that is too large. Where both leave out as many, it is the later ones.

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
    return ahead if ahead.sum() == keep.sum() else keep
