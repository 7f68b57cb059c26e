"""Times of a recording, some of which are wrong: which are sound, and values for the others."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

__all__ = ["MOST_WRONG", "filled", "increasing", "sound"]

STILL = 0.1  # a step that is shorter, in median steps, is none: the stamp was written twice
FARTHEST = 1e9  # median steps from the other stamps, beyond which a stamp is none: years, at a camera's rate
MOST_WRONG = 0.1  # a share of times that are wrong, up to which the others are trusted


def sound(times: np.ndarray) -> np.ndarray:
    """Stamps that are finite and increase, not by next to nothing, and not by more than any clock does, bool ``[N]``.

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
    """The times with those that are not sound on straight lines between the others, and beyond these.

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
    """Which values belong to the longest strictly increasing sub-sequence, bool ``[N]``.

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
