"""Times of a drive's frames: masks invalid stamps, interpolates them, and computes the time steps."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torch_denkf.applications.car.vision.poses import KITTI_DT
from torch_denkf.data.text import read_lines, read_number
from torch_denkf.data.times import MOST_WRONG, filled, sound

__all__ = ["GAP", "Times", "read_times"]

GAP = 1.5  # median steps: a longer step is a gap, which no image pair crosses
SHORTEST, LONGEST = (
    1e-3,
    2.0,
)  # s between frames; other medians are errors of the unit, or too long for flow


class Times(NamedTuple):
    """Times of a drive's frames.

    Attributes:
        times: s, increasing, ``[N]``; invalid stamps are interpolated.
        dt: s since the frame before, ``[N]``: the median, except in rows after a gap.
        sound: whether the stamp of the file is valid, bool ``[N]``.
        median: s, the frame time.
    """

    times: np.ndarray
    dt: np.ndarray
    sound: np.ndarray
    median: float


def read_times(file: Path, rows: int) -> Times:
    """Reads the frames' times, or returns nominal ones if there is no file.

    A warning counts the stamps that do not increase, which are not used, and the gaps.

    Args:
        file: ``sequences/NN/times.txt``.
        rows: number of frames.

    Returns:
        The times of the first ``rows`` frames. Their median is over all rows of the file, 0.103 s if there is none.

    Raises:
        ValueError: naming file and line, if the file has fewer rows, if a row is no finite number, if more than a
            tenth of its times do not increase, or if they cannot be in seconds.
    """
    if file.exists() and not file.is_file():
        raise ValueError(f"{file} is no file; expected a time in s for each frame, a row each")
    if not file.is_file():
        return Times(KITTI_DT * np.arange(rows), np.full(rows, KITTI_DT), np.ones(rows, bool), KITTI_DT)
    lines = read_lines(file)
    while lines and not lines[-1].strip():
        lines.pop()
    if len(lines) < rows:
        raise ValueError(f"{file} has {len(lines)} times, but there are {rows} posed frames; add the missing rows")
    times = np.array([_seconds(file, number, line) for number, line in enumerate(lines, start=1)])
    good = sound(times)
    wrong = np.flatnonzero(~good)
    if len(wrong) > MOST_WRONG * len(times):
        raise ValueError(
            f"{file}:{wrong[0] + 1}: the time {times[wrong[0]]:g} s does not increase, nor do {len(wrong) - 1} others "
            f"of {len(times)}; expected increasing seconds, one a frame: write them again, or take the file away "
            f"(frames are then {KITTI_DT} s apart)"
        )
    if len(wrong):
        warnings.warn(
            f"{file}: {len(wrong)} of {len(times)} times do not increase, the first in line {wrong[0] + 1} "
            f"({times[wrong[0]]:g} s); their frames count as missing (frame_valid False)",
            stacklevel=5,
        )
        times = filled(times, good, KITTI_DT)
    return _with_steps(file, times, good, rows)


def _seconds(file: Path, number: int, line: str) -> float:
    try:
        (word,) = line.split()
        value = read_number(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        words = len(line.split())
        raise ValueError(f"{file}:{number}: expected 1 finite number (seconds), got {words} words: {line[:60]!r}")
    return value


def _with_steps(file: Path, times: np.ndarray, good: np.ndarray, rows: int) -> Times:
    if len(times) < 2:
        return Times(times, np.full(len(times), KITTI_DT), good, KITTI_DT)
    steps = np.diff(times)
    median = float(np.median(steps))
    if not SHORTEST <= median <= LONGEST:
        raise ValueError(
            f"{file}: the median difference of its times is {median:g} s, expected {SHORTEST:g} to {LONGEST:g}; write "
            "the times in seconds"
        )
    # Stamps jitter, although the camera's rate is steady: a step keeps its length only if it is too long or short for
    # jitter.
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
    return Times(times[:rows], dt[:rows], good[:rows], median)
