"""A log as the rows that a robot's filter reads, and the belief that it starts from."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.applications.robot.config import Config
from torch_denkf.applications.robot.model import RobotModel
from torch_denkf.applications.robot.motion import ANGLES, STATES
from torch_denkf.applications.robot.readings import Seen, from_north, seen_by, unread
from torch_denkf.data.recordings.offsets import ClockOffset, Delay, delays_between, solved
from torch_denkf.data.recordings.outliers import without_outliers
from torch_denkf.data.recordings.quantities import find
from torch_denkf.data.recordings.streams import Stream, streams_of

__all__ = [
    "RobotLog",
    "default_settings",
    "drift_settings",
    "log_streams",
    "not_used",
    "read_log",
    "rows_of_log",
    "start_of",
]

_RATE = 2.0  # Hz, of rows to learn from
_SHARE = 0.05  # of a speed, or of a reading's spread: size of a drift before it is learned
_PLACES = "latitude and longitude, x and y, or east and north"
_AWAY = 5.0  # m, from the first fix to the one that tells the heading


@dataclass(frozen=True)
class RobotLog:
    """Readings of all sensors of a filter.

    Attributes:
        seen: by the name of the sensor.
        offsets: that were found between the streams of the log, and taken out.
        origin: of the local frame, in degrees; ``None`` where there is no latitude.
        outliers: by sensor of the settings: how many fixes are left out, since they are far from those around them.
    """

    seen: Mapping[str, Seen]
    offsets: Mapping[str, ClockOffset]
    origin: tuple[float, float] | None
    outliers: Mapping[str, int]


def log_streams(*files: Path) -> dict[str, Stream]:
    """Returns the streams of a log of some files; raises as :func:`~torch_denkf.data.recordings.streams.streams_of`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of float32, which no number becomes here, and of repeats, which are left out
        return streams_of(*files)


def default_settings(streams: Mapping[str, Stream]) -> dict:
    """Returns settings for a log without any: in the plane, all sensors that a stream's columns tell.

    Raises:
        ValueError: if they tell none.
    """
    settings: dict = {"frequency": 10.0, "two_d_mode": True, "initial_estimate_covariance": [10.0] * 2 + [1.0] * 13}
    kinds = {"pose": ("latitude", (0, 1)), "twist": ("speed", (6, 7)), "imu": ("turn rate", (11,))}
    for kind, (what, places) in kinds.items():
        number = 0
        for name, stream in streams.items():
            if find(stream.readings.columns, what) or (kind == "pose" and find(stream.readings.columns, "east")):
                settings[f"{kind}{number}"] = name
                columns = stream.readings.columns
                turned = any(map(from_north, columns)) or (find(columns, "east") and find(columns, "heading"))
                read = (*places, 5) if kind == "pose" and turned else places
                settings[f"{kind}{number}_config"] = [place in read for place in range(15)]
                number += 1
    if not any(name.endswith("_config") for name in settings):
        every = [name for stream in streams.values() for name in (*stream.readings.columns, *stream.others)]
        raise ValueError(f"none of the columns {every} is known; names are {_PLACES}, speed, heading or yaw_rate")
    return settings


def not_used(streams: Mapping[str, Stream], config: Config) -> list[str]:
    """Returns texts on the topics and columns that the settings do not read, and on missing position fixes."""
    read: dict[str, list[int]] = {}
    for sensor in config.sensors:
        read.setdefault(sensor.topic.strip("/"), []).extend(place for each in sensor.groups.values() for place in each)
    unused: list[str] = []
    for name, stream in streams.items():
        places = read.get(name.strip("/"), [])
        if stream.table.topic is None:
            unused += [*unread(stream.readings.columns, places), *stream.others]
        elif not places:
            unused.append(name)
    out = [f"not used: {', '.join(unused)}"] if unused else []
    if not any({0, 1} & set(places) for places in read.values()):
        out.append(
            f"no position fixes: the path starts at the origin and drifts; names of position columns are {_PLACES}"
        )
    return out


def read_log(file: Path | str, config: Config, streams: Mapping[str, Stream]) -> RobotLog:
    """Reads the streams that the settings name, takes out their delays, and brings them into m, s and rad.

    Raises:
        ValueError: if the log lacks a stream or a column.
    """
    topics = {sensor.name: _found(sensor.topic, streams, file) for sensor in config.sensors}
    screened = {topic: without_outliers(streams[topic].readings) for topic in topics.values()}
    tables = {topic: table for topic, (table, _) in screened.items()}
    delays: list[Delay] = delays_between(tables)
    offsets = solved(delays, tables) if delays else {}
    # A delay that may be chance is none; a sensor whose delay is given has that.
    offsets = {name: one for name, one in offsets.items() if one.sure}
    origin = None
    for table in tables.values():
        if origin is None and (places := find(table.columns, "latitude", "longitude")):
            origin = (float(table.values[0, places[0]]), float(table.values[0, places[1]]))
    seen = {}
    for sensor in config.sensors:
        topic = topics[sensor.name]
        table = tables[topic]
        if not sensor.delay and topic in offsets:
            table = table._replace(times=table.times + offsets[topic].seconds)
        ways = [delay for delay in delays if delay.what == "way" and topic in (delay.late, delay.early)]
        scale = max([abs(each.scale if each.late == topic else 1 / each.scale) for each in ways], default=1.0)
        for group in sensor.groups:
            seen[f"{sensor.name}_{group}"] = seen_by(sensor, group, config, table, origin, scale)
    return RobotLog(seen, offsets, origin, {name: screened[topic][1] for name, topic in topics.items()})


def drift_settings(log: RobotLog, model: RobotModel) -> dict:
    """Returns the settings with drifts of all readings that vary, to learn from; those that are given stay.

    Rows are few: fast readings are means, whose noise is what matters for a path, and is learned for this rate alone.
    Velocities are held for a step, and without process noise in the settings it follows from how they change in 1 s.
    A pose drifts by what the log says of its noise; a forward speed by a share, other readings by one of their spread.
    """
    settings = {"held_velocities": True, **model.config.given, "frequency": min(_RATE, model.config.frequency)}
    walks = [1e-2] * 3 + [1e-4] * 3 + [1e-2] * 9  # the variance that a second adds
    for sensor in model.config.sensors:
        drifts = [0.0] * len(STATES)
        for group in sensor.groups:
            seen = log.seen[f"{sensor.name}_{group}"]
            back = 6 if sensor.differential and group == "pose" else 0
            for at, place in enumerate(model.reads[f"{sensor.name}_{group}"]):
                column = np.unwrap(seen.values[:, at]) if place in ANGLES else seen.values[:, at]
                if np.ptp(column) == 0:
                    continue
                if 6 <= place < 12:
                    later = np.interp(seen.times + 1.0, seen.times, column)
                    walks[place] = float(np.square(later - column).mean())
                drifts[place - back] = _SHARE if place == STATES.index("vx") else _SHARE * float(column.std())
                if place < 3:
                    drifts[place] = float(np.sqrt(np.median(seen.noise[:, at, at])))
        settings.setdefault(f"{sensor.name}_drifts", drifts)
    settings.setdefault("process_noise_covariance", walks)
    return settings


def _found(topic: str, streams: Mapping[str, Stream], file: Path | str) -> str:
    for name in streams:
        if name.strip("/") == topic.strip("/"):
            return name
    raise ValueError(f"{file} has no stream {topic!r}; it has {list(streams)}: see denkf log {file}")


def rows_of_log(log: RobotLog, model: RobotModel, hidden: np.ndarray | None = None) -> TensorDict:
    """Makes rows ``[T]`` of all poses, of fast ones of every so many, and of ``frequency`` where none is near.

    Readings of other sensors that are as fast stand in the row that is nearest to them, as their mean; in the one
    before them if the model holds velocities for a step. Those of slow ones have rows of their own.

    Args:
        log: the readings.
        model: whose sensors read them.
        hidden: intervals in s ``[N, 2]`` in which poses are not observed, after the first row.
    """
    rate = model.config.frequency
    poses = {name for name in log.seen if name.endswith("_pose") and model.reads[name][0] < 6}
    streams = {name: seen.every(int(_rate(seen) / rate)) if name in poses else seen for name, seen in log.seen.items()}
    own = {name: name in poses or _rate(seen) < 0.7 * rate for name, seen in streams.items()}
    exact = np.unique(np.concatenate([[], *(seen.times for name, seen in streams.items() if own[name])]))
    begin = min(seen.times[0] for seen in streams.values())
    end = max(seen.times[-1] for seen in streams.values())
    ticks = np.arange(begin, end, 1 / rate)
    if len(exact):
        begin = exact[0]
        right = np.searchsorted(exact, ticks).clip(1, max(len(exact) - 1, 1))
        near = np.minimum(np.abs(ticks - exact[right - 1]), np.abs(ticks - exact[right.clip(max=len(exact) - 1)]))
        ticks = ticks[(near > 0.5 / rate) & (ticks > begin)]
    times = np.unique(np.concatenate([[begin], exact, ticks]))
    rows = {"stamp": times[:, None], "dt": np.diff(times, prepend=begin)[:, None]}
    edges = times[1:] if model.config.held else (times[1:] + times[:-1]) / 2
    for name, seen in streams.items():
        place = np.searchsorted(times, seen.times) if own[name] else np.searchsorted(edges, seen.times, "right")
        inside = (seen.times >= begin) & (seen.times <= times[-1] + 0.5 / rate)
        place, values, noise = place[inside], seen.values[inside], seen.noise[inside]
        count = np.bincount(place, minlength=len(times))
        angles = [at for at, state in enumerate(model.reads[name]) if state in ANGLES]
        values[:, angles] = np.unwrap(values[:, angles], axis=0)
        total, spread = np.zeros((len(times), values.shape[1])), np.zeros((len(times), *noise.shape[1:]))
        np.add.at(total, place, values)
        np.add.at(spread, place, noise)
        divide = count.clip(1)
        spread[count == 0] = np.eye(noise.shape[1])
        observed = count > 0
        observed[0] = False
        if hidden is not None and name.endswith("_pose"):
            observed &= ~((times[:, None] > hidden[:, 0]) & (times[:, None] < hidden[:, 1])).any(1)
        rows[name], rows[f"{name}_noise"] = total / divide[:, None], spread / divide[:, None, None]
        rows[f"{name}_observed"] = observed[:, None]
    return TensorDict({name: torch.from_numpy(value) for name, value in rows.items()}, [len(times)])


def _rate(seen: Seen) -> float:
    return len(seen.times) / max(seen.times[-1] - seen.times[0], 1e-9)


def start_of(log: RobotLog, model: RobotModel) -> RobotModel:
    """Returns the model that starts where the first readings say: place, heading, speed."""
    mean, cov = model.config.initial_state.copy(), model.config.initial_cov.copy()
    if "initial_state" in model.config.given:
        return model
    known = set()
    for name, seen in log.seen.items():
        for at, place in enumerate(model.reads[name][: seen.values.shape[1]]):
            if place not in known and seen.noise[0, at, at] > 1e-6:
                mean[place] = seen.values[0, at]
                cov[place, :] = cov[:, place] = 0.0
                cov[place, place] = max(seen.noise[0, at, at], 1e-6)
                known.add(place)
    poses = [seen for name, seen in log.seen.items() if tuple(model.reads[name][:2]) == (0, 1)]
    if 5 not in known and poses:
        fixes = poses[0].values[:, :2]
        far = np.flatnonzero(np.linalg.norm(fixes - fixes[0], axis=1) > _AWAY)
        if len(far):
            mean[5] = np.arctan2(*(fixes[far[0]] - fixes[0])[::-1])
            cov[5, 5] = 1.0
    dtype = model.filter.initial.mean.dtype
    return replace(model).started(torch.as_tensor(mean, dtype=dtype), torch.as_tensor(cov, dtype=dtype))
