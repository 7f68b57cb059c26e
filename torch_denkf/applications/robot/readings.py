"""Readings of a log as the states that a sensor of robot_localization reads, and their covariances."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from torch_denkf.applications.robot.config import PLANE, Config, SensorConfig
from torch_denkf.data.earth import to_local
from torch_denkf.data.recordings.outliers import fixes_of
from torch_denkf.data.recordings.quantities import SPEEDS, find, in_radians, quantity, speed_unit
from torch_denkf.data.recordings.tables import Readings

__all__ = ["Seen", "from_north", "seen_by", "unread"]

#: The states that quantities tell.
_TOLD = {
    **dict.fromkeys(("latitude", "longitude", "east", "north", "hdop"), (0, 1)),
    **{"heading": (5,), "speed": (6, 7), "turn rate": (11,), "acceleration": (12, 13, 14)},
}
_XYZ = ("x", "y", "z")
_SLIP = 0.1  # m/s: standard deviation of a vehicle's speed sideways and upwards, which is read as zero
_FIRST = 1.0  # m of standard deviation for each unit of hdop, and of what nothing is known


class Seen(NamedTuple):
    """Readings of one sensor of the filter.

    Attributes:
        times: s, ``[n]``.
        values: of the states that are read ``[n, O]``.
        noise: covariances ``[n, O, O]``.
        stated: whether the log or the settings say them.
    """

    times: np.ndarray
    values: np.ndarray
    noise: np.ndarray
    stated: bool

    def every(self, count: int) -> Seen:
        """Returns each of so many readings; all for a count of one or less."""
        kept = slice(None, None, max(count, 1))
        return Seen(self.times[kept], self.values[kept], self.noise[kept], self.stated)


def from_north(name: str) -> bool:
    """Tells whether a column is a compass heading, clockwise from north.

    Examples:
        >>> from_north("Compass heading [deg]"), from_north("COG [deg]"), from_north("theta")
        (True, False, False)
    """
    return bool(re.search("compass|magnetic|true_?heading", name.lower()))


def unread(columns: Sequence[str], places: Collection[int]) -> list[str]:
    """Lists the columns with other than usual names, or of which no state is read.

    Examples:
        >>> unread(["position_m", "yaw_rate", "ax", "ay", "speed"], [6, 11])
        ['position_m', 'ax', 'ay']
    """
    found = [quantity(name) for name in columns]
    first = found.index("acceleration") if "acceleration" in found else len(found)
    others = ["acceleration" if first < at < first + 3 else name.lower() for at, name in enumerate(columns)]  # y and z
    known = [what or other for what, other in zip(found, others, strict=True)]
    return [name for name, what in zip(columns, known, strict=True) if not set(_TOLD.get(what, ())) & set(places)]


def seen_by(
    sensor: SensorConfig, group: str, config: Config, table: Readings, origin: Sequence[float] | None, scale: float
) -> Seen:
    """Extracts a sensor's readings of state components from a log.

    Args:
        sensor: its settings.
        group: ``"pose"``, ``"twist"`` or ``"acceleration"``.
        config: all settings.
        table: the log's columns, of a ROS message or with usual names.
        origin: of a local frame, degrees, for latitudes and longitudes.
        scale: of its speeds to those of other sensors, which tells their unit where no name does.

    Raises:
        ValueError: if the log lacks a state that the settings read; names it.
    """
    values, variances = _states(table, origin, scale)
    if sensor.without_gravity and group == "acceleration":
        values[:, 12:] -= _gravity(values[:, 3:6], config.gravity)
    times = table.times - sensor.delay
    places = list(sensor.groups[group])
    if config.two_d:
        places = [place for place in places if place not in PLANE]
    unknown = [place for place in places if np.isnan(values[:, place]).all()]
    if unknown:
        from torch_denkf.applications.robot.motion import STATES

        raise ValueError(
            f"{sensor.name}_config reads {[STATES[place] for place in unknown]}, of which {sensor.topic!r} has no "
            f"column among {list(table.columns)}"
        )
    if sensor.relative and group == "pose":
        first = values[0].copy()
        cos, sin = np.cos(first[5]), np.sin(first[5])
        away = values[:, :2] - first[:2]
        values[:, 0], values[:, 1] = cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]
        values[:, 2:6] -= first[2:6]
    if sensor.differential and group == "pose":
        times, values, variances = _differences(times, values, variances)
        places = [place + 6 for place in places]
    stated = np.isfinite(variances[:, places, places]).all() or bool(sensor.variances)
    if sensor.variances:
        variances = np.broadcast_to(np.diag(sensor.variances), variances.shape).copy()
    spread = np.diag(np.nan_to_num(variances[0].diagonal(), nan=_FIRST**2))
    noise = np.where(np.isfinite(variances), variances, spread)[:, places][:, :, places]
    size = noise.shape[-1]
    diagonal = np.abs(noise[:, range(size), range(size)]).clip(1e-9)
    noise[:, range(size), range(size)] = np.where(diagonal > 1e-9, diagonal, _FIRST**2 if not stated else diagonal)
    read = values[:, places]
    if config.two_d:
        read = np.concatenate([read, np.zeros((len(read), len(PLANE)))], 1)
        whole = np.zeros((len(read), size + len(PLANE), size + len(PLANE)))
        whole[:, :size, :size], whole[:, range(size, whole.shape[1]), range(size, whole.shape[1])] = noise, 1e-6
        noise = whole
    there = np.isfinite(read).all(1)
    return Seen(times[there], read[there], noise[there], stated)


def _states(table: Readings, origin: Sequence[float] | None, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the states of each row ``[n, 15]`` and their covariances ``[n, 15, 15]``; NaN if unknown."""
    count, columns = (
        len(table.times),
        dict(zip(table.columns, table.values.T, strict=True)),
    )
    values, cov = np.full((count, 15), np.nan), np.full((count, 15, 15), np.nan)
    ros = any(re.search(r"(position|linear|angular_velocity|orientation)\.[xyz]$", name) for name in columns)
    if ros:
        _of_message(columns, values, cov)
    else:
        _of_names(table, columns, values, cov, origin, scale)
    return values, cov


def _of_message(columns: Mapping[str, np.ndarray], values: np.ndarray, cov: np.ndarray) -> None:
    """Fills in the fields of an odometry, a pose, a twist or an inertial message."""
    parts = (("position", 0), ("linear", 6), ("angular", 9), ("angular_velocity", 9), ("linear_acceleration", 12))
    for name, column in columns.items():
        for part, begin in parts:
            if (axis := name[-1:]) in _XYZ and re.search(rf"(^|\.){part}\.{axis}$", name):
                values[:, begin + _XYZ.index(axis)] = column
    if turned := [name for name in columns if re.search(r"orientation\.w$", name)]:
        stem = turned[0][:-1]
        values[:, 3:6] = _angles(*(columns[stem + axis] for axis in ("w", *_XYZ)))
    blocks = [("pose.covariance", 0, 6), ("twist.covariance", 6, 6), ("orientation_covariance", 3, 3)]
    blocks += [("angular_velocity_covariance", 9, 3), ("linear_acceleration_covariance", 12, 3)]
    for stem, begin, size in blocks:
        if f"{stem}.0" in columns:
            block = np.stack([columns[f"{stem}.{place}"] for place in range(size * size)], -1)
            cov[:, begin : begin + size, begin : begin + size] = block.reshape(-1, size, size)


def _of_names(
    table: Readings,
    columns: Mapping[str, np.ndarray],
    values: np.ndarray,
    cov: np.ndarray,
    origin: Sequence[float] | None,
    scale: float,
) -> None:
    """Fills in columns with usual names."""
    if places := find(table.columns, "latitude", "longitude"):
        values[:, :2] = to_local(table.values[:, places], origin or table.values[0, places].tolist())
    elif (fixes := fixes_of(table.columns, table.values)) is not None:
        values[:, :2] = fixes
    for name, column in columns.items():
        what = quantity(name)
        if what == "heading" and (from_north(name) or np.isnan(values[:, 5]).all()):  # a compass before a course
            angle = in_radians(name, column)
            clockwise = from_north(name) or re.search("course|cog|track", name.lower())
            values[:, 5] = np.pi / 2 - angle if clockwise else angle
        elif what == "turn rate":
            values[:, 11] = in_radians(name, column)
        elif what == "speed" and np.isnan(values[:, 6]).all():
            unit = speed_unit(name, scale)
            values[:, 6], values[:, 7:9] = column / SPEEDS[unit][0] if unit else column, 0.0
            cov[:, 7, 7] = cov[:, 8, 8] = _SLIP**2
        elif what == "acceleration":
            begin = table.columns.index(name)
            values[:, 12 : 12 + min(3, len(columns) - begin)] = table.values[:, begin : begin + 3]
        elif name.lower() == "hdop":
            cov[:, :2, :2] = (np.square(_FIRST * column))[:, None, None] * np.eye(2)


def _angles(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw of unit quaternions."""
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin((2 * (w * y - z * x)).clip(-1, 1))
    return np.stack([roll, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))], -1)


def _gravity(angles: np.ndarray, gravity: float) -> np.ndarray:
    """Gravity's share of an accelerometer's reading, in the body's axes."""
    roll, pitch = np.nan_to_num(angles[:, :2]).T
    return gravity * np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], -1)


def _differences(times: np.ndarray, values: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns velocities and turn rates in the body's axes, from consecutive poses."""
    step = np.diff(times)[:, None]
    speed, out = np.diff(values[:, :3], axis=0) / step, np.full((len(step), 15), np.nan)
    middle = np.nan_to_num(values[:-1, 5]) + 0.5 * _wrapped(np.nan_to_num(np.diff(values[:, 5])))
    out[:, 6] = np.cos(middle) * speed[:, 0] + np.sin(middle) * speed[:, 1]
    out[:, 7] = np.cos(middle) * speed[:, 1] - np.sin(middle) * speed[:, 0]
    out[:, 8], out[:, 9:12] = speed[:, 2], _wrapped(np.diff(values[:, 3:6], axis=0)) / step
    spread = np.full((len(step), 15, 15), np.nan)
    spread[:, 6:12, 6:12] = (cov[1:, :6, :6] + cov[:-1, :6, :6]) / np.square(step)[:, :, None]
    return times[1:], out, spread


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
