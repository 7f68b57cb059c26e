"""Fixes of a log that are far from all fixes around them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torch_denkf.data.earth import to_local
from torch_denkf.data.recordings.quantities import find, metres
from torch_denkf.data.recordings.tables import Readings, changes

__all__ = ["fixes_of", "outlying", "without_outliers"]

_WINDOW = 11  # fixes, the one that is judged among them
_FAR = 8.0  # standard deviations of the fixes around it
_RAYLEIGH = 1.1774  # median of a distance in the plane for a standard deviation of one
_GAP = 5.0  # usual steps: windows do not cross longer ones
_REWEIGHTED, _ROUNDS = 15, 3


def fixes_of(columns: Sequence[str], values: np.ndarray) -> np.ndarray | None:
    """Returns the places ``[n, 2]`` of a table's rows in metres; ``None`` where it has none."""
    if places := find(columns, "latitude", "longitude"):
        return to_local(values[:, places], np.median(values[:, places], 0))
    if places := find(columns, "east", "north"):
        return values[:, places] * [metres(columns[place]) for place in places]
    return None


def outlying(times: np.ndarray, fixes: np.ndarray) -> np.ndarray:
    """Marks fixes that are far from the parabola of least distances through those around them, bool ``[n]``.

    Far is eight times what the others differ from it, those around or those of the whole log, which differ more: in
    turns that a parabola does not follow, few are outliers. Of a window, less than half may be outliers; fixes that are
    off together for longer are none. Near the ends of a window more is needed, and stretches that are shorter than a
    window are not judged.

    Args:
        times: s, ``[n]``.
        fixes: m, ``[n, 2]``; a row that repeats the one before it is judged as that one.
    """
    new = changes(fixes)
    kept = np.flatnonzero(new)
    for _ in range(_ROUNDS):  # outliers that stand close hide each other
        far = _far(times[kept], fixes[kept])
        kept = kept[~far]
        if not far.any():
            break
    return ~np.isin(np.flatnonzero(new), kept)[np.cumsum(new) - 1]


def _far(seconds: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Marks fixes that are far from those around them, in one round."""
    marked, steps = np.zeros(len(places), bool), np.diff(seconds)
    part = np.append(0, np.cumsum(steps > _GAP * np.median(steps))) if len(steps) else np.zeros(len(places), int)
    begin, end = np.searchsorted(part, part), np.searchsorted(part, part, "right")
    judged = np.flatnonzero(end - begin >= _WINDOW)
    if not len(judged):
        return marked
    first = (judged - _WINDOW // 2).clip(begin[judged], end[judged] - _WINDOW)
    around = first[:, None] + np.arange(_WINDOW)
    at = seconds[around] - seconds[judged][:, None]
    at /= np.abs(at).max(1, keepdims=True)
    design = np.stack([np.ones_like(at), at, at * at], -1)
    own = around == judged[:, None]
    near = places[around] - places[judged][:, None]
    weight = np.where(own, 0.0, 1.0)  # a fix is compared with what the others say
    for _ in range(_REWEIGHTED):
        weighted = design * weight[..., None]
        normal = design.swapaxes(1, 2) @ weighted + 1e-12 * np.eye(3)
        off = np.linalg.norm(near - design @ np.linalg.solve(normal, weighted.swapaxes(1, 2) @ near), axis=-1)
        spread = np.median(off, 1, keepdims=True)
        weight = np.where(own, 0.0, 1 / np.maximum(off, 1e-2 * spread + 1e-12))
    usual = np.median(off, 1) / _RAYLEIGH
    # Leverage: least squares that leave a sound fix out miss it by more at the end of a window than in its middle.
    hat = np.linalg.inv(design.swapaxes(1, 2) @ design)
    lever = np.einsum("ni,nij,nj->n", design[own], hat, design[own])
    marked[judged] = off[own] * (1 - lever) > _FAR * np.maximum(usual, np.median(usual))
    return marked


def without_outliers(table: Readings) -> tuple[Readings, int]:
    """Returns the rows whose fixes are no outliers, and how many fixes are; all rows of a table without places."""
    fixes = fixes_of(table.columns, table.values)
    if fixes is None or table.arrived is not None:
        return table, 0
    far = outlying(table.times, fixes)
    return table._replace(times=table.times[~far], values=table.values[~far]), int((far & changes(fixes)).sum())
