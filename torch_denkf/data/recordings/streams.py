"""Finds the streams of a log, topics of a bag or columns of a file that change together, and their oddities."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from torch_denkf.data.recordings.bags import bag_topics, is_bag
from torch_denkf.data.recordings.outliers import without_outliers
from torch_denkf.data.recordings.quantities import quantity
from torch_denkf.data.recordings.sources import sparse_columns
from torch_denkf.data.recordings.tables import Readings, Table
from torch_denkf.diagnosis.logs import repeats

__all__ = ["Stream", "streams_of"]

_TOGETHER = 0.8  # share of common changes from which two columns belong to the same sensor
_GAP = 10  # median steps
_BURST = 0.1  # median steps
_NAMES = {"latitude": "gps", "east": "position", "turn rate": "imu", "acceleration": "imu", "speed": "speed"}
_PARTNERS = {"latitude": "longitude", "longitude": "latitude", "east": "north", "north": "east"}
_TURNS, _GRAVITY = 7.0, (5.0, 20.0)  # rad/s beyond any robot; range of the median acceleration's norm, m/s^2


class Stream(NamedTuple):
    """A stream of a log.

    Attributes:
        table: table that reads it.
        readings: readings of the table.
        repeated: share of rows that repeat a reading.
        others: columns of numbers of its file that are in no stream; with the first stream of the file.
    """

    table: Table
    readings: Readings
    repeated: float
    others: tuple[str, ...] = ()

    @property
    def rate(self) -> float:
        """Returns the number of readings per second."""
        return 1 / float(np.median(np.diff(self.readings.times))) if len(self.readings.times) > 1 else 0.0

    def oddities(self) -> list[str]:
        """Returns texts about oddities: repeats, gaps, bursts, outliers, and units that look wrong."""
        times, out = self.readings.times, []
        steps = np.diff(times)
        usual = float(np.median(steps)) if len(steps) else 0.0
        if self.repeated:
            out.append(f"repeated in {self.repeated:.0%} of the rows")
        if (gaps := np.flatnonzero(steps > max(_GAP * usual, 0.5))).size:
            longest = gaps[steps[gaps].argmax()]
            out.append(f"{len(gaps)} gaps, the longest {steps[longest]:.3g} s at {times[longest] - times[0]:.4g} s")
        if (share := float((steps < _BURST * usual).mean()) if len(steps) else 0.0) > 0.01:
            out.append(f"bursts: {share:.0%} of the steps are below {_BURST * usual:.2g} s")
        if far := without_outliers(self.readings)[1]:
            out.append(f"{far} outliers, fixes that are far from all around them")
        for name, column in zip(self.readings.columns, self.readings.values.T, strict=True):
            if np.ptp(column) == 0:
                out.append(f"{name} is always {column[0]:g}")
            size, what = float(np.quantile(np.abs(column), 0.99)), quantity(name)
            if what in ("turn rate", "heading") and size > _TURNS:
                out.append(f"{name} looks like degrees")
        axes = [name for name in self.readings.columns if quantity(name) == "acceleration"]
        if axes:
            at = self.readings.columns.index(axes[0])
            size = float(np.median(np.linalg.norm(self.readings.values[:, at : at + 3], axis=1)))
            if self.readings.values.shape[1] >= at + 3 and not _GRAVITY[0] < size < _GRAVITY[1]:
                out.append(f"accelerations of {size:.3g} look like another unit than m/s^2")
        return out


def streams_of(*files: str | Path, **options) -> dict[str, Stream]:
    """Finds the streams of a log.

    Args:
        *files: files of :class:`~torch_denkf.data.Table`, with times of one clock.
        **options: options of the tables, such as ``time`` and ``unit``.

    Returns:
        Streams by name: topics, or names of sensors by the quantities of their columns.

    Raises:
        FileNotFoundError: without the file.
        ImportError: for bags without rosbags.
        ValueError: if the file cannot be read.
    """
    if not files:
        raise ValueError("no log was given: name a file, or several of one clock")
    found: dict[str, Stream] = {}
    for file in files:
        for name, stream in _of_file(Path(file).expanduser(), **options).items():
            while name in found:
                name += "_"
            found[name] = stream
    return found


def _of_file(path: Path, **options) -> dict[str, Stream]:
    found: dict[str, Stream] = {}
    if is_bag(path):
        for topic in sorted(bag_topics(path)):
            table = Table(path, topic=topic, **options)
            try:
                found[topic] = Stream(table, table.read(), 0.0)
            except ValueError:  # a topic of images or text
                continue
        return found
    full, sparse = sparse_columns(path, options.get("time"))
    others: list[str] = []
    groups: list[list[str] | None] = [each for each in (full, *sparse) if each]
    for group in groups or [None]:
        whole = Table(path, group, **options).read()
        others += whole.columns
        for columns in _together(whole):
            slow = any(repeats(whole.values[:, whole.columns.index(name)]) for name in columns)
            table = Table(path, columns, repeats="drop" if slow else "keep", **options)
            read = table.read()
            known = [what for what in map(quantity, columns) if what]
            name = next((named for what, named in _NAMES.items() if what in known), (known or columns)[0])
            while name in found:
                name += "_"
            found[name] = Stream(table, read, 1 - len(read.times) / len(whole.times))
            others = [each for each in others if each not in columns]
    for name in list(found)[:1]:
        found[name] = found[name]._replace(others=tuple(others))
    return found


def _together(table: Readings) -> list[list[str]]:
    """Groups columns that change in the same rows; of those that never change, only one of a place's two is kept."""
    groups: list[tuple[np.ndarray, list[str]]] = []
    fast: list[str] = []
    still: list[str] = []
    for name, column in zip(table.columns, table.values.T, strict=True):
        changed = np.diff(column) != 0
        if not changed.any():
            still.append(name)
            continue
        if not repeats(column) and changed.mean() > 0.5:
            fast.append(name)
            continue
        for other, names in groups:
            if (changed & other).sum() > _TOGETHER * min(changed.sum(), other.sum()):
                names.append(name)
                other |= changed
                break
        else:
            groups.append((changed, [name]))
    for name in still:  # a robot may drive along an axis
        partner = _PARTNERS.get(quantity(name) or "")
        for names in (fast, *(names for _, names in groups)):
            if partner in map(quantity, names):
                names.append(name)
                break
    known = [names for _, names in groups if any(map(quantity, names))]
    return [names for names in _by_sensor(fast) if names] + known


def _by_sensor(names: list[str]) -> list[list[str]]:
    """Groups columns by sensor: inertial and unknown ones, speeds, and poses."""
    speeds = [name for name in names if quantity(name) == "speed"]
    poses = [name for name in names if quantity(name) in ("heading", "east", "north", "latitude", "longitude")]
    return [[name for name in names if name not in (*speeds, *poses)], speeds, poses]
