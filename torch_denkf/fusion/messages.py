"""Conversion of a log of asynchronous messages to rows for a filter, without resampling to a clock."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf._checks import check_number
from torch_denkf.diagnosis.logs import SECONDS, Unit, in_origin, look_at_numbers, look_at_times, warn_of_log

__all__ = ["message_rows"]

_SILENT = 20  # median steps without a message from which a driving sensor counts as silent


def message_rows(
    messages: Iterable[Sequence[Any]],
    *,
    driving: Sequence[str] = (),
    rows_of: Sequence[str] | None = None,
    delays: Mapping[str, float] | None = None,
    start: float | None = None,
    unit: Unit = "s",
    origin: Mapping[str, Any] | None = None,
    dtype: torch.dtype | None = None,
) -> TensorDict:
    """Returns rows ``[T]`` of a log of asynchronous sensors with different rates.

    Each time of a reading is a row, and ``"dt"`` ``[T, 1]`` is the time since the row before, s: the transition must
    read it. The first row is the start of the filter, and has no message. Two messages of a sensor with the same stamp
    get two rows, the second with a ``dt`` of zero.

    A sensor's reading is stored under its name, ``[T, O]``, and its mask under NAME_observed, as
    :class:`~torch_denkf.fusion.FusedSensor` expects them; rows without a reading are NaN. Noise in messages is stored
    under NAME_noise, the key for ``FusedSensor(noise=...)``.

    Args:
        messages: ``(stamp, sensor, value)`` or ``(stamp, sensor, value, noise)``, in any order: the stamp, the sensor's
            name, ``[O]`` numbers, and the reading's variances ``[O]`` or covariance ``[O, O]``, of tangents if the
            reading is a point of a space.
        driving: sensors that drive the motion, such as ``"imu"``. They have no mask: each row has the mean since the
            row before, with linear interpolation between the messages, and constant extrapolation before the first and
            after the last. A gap longer than twenty median steps warns. Messages that are not finite are left out.
        rows_of: sensors whose times become rows: all that do not drive, and optionally driving ones; by default all. A
            fast driving sensor that is left out is averaged over each longer step.
        delays: delay of each sensor's stamps after the measurement, s, by name.
        start: time of the first row, in seconds; by default that of the first reading. Earlier readings are left out.
        unit: of the stamps: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``. All else is in seconds.
        origin: offset that is subtracted from the readings of a sensor, by name, a number or ``[O]``, in float64,
            before the conversion to float32, which has seven digits: metres of a map, degrees of latitude or encoder
            ticks lose their last ones. A warning says where.
        dtype: of the numbers, floating; torch's default.

    Returns:
        The rows, with ``"stamp"`` ``[T, 1]`` in float64.

    Raises:
        ValueError: if there is no message, a message is malformed or has no finite stamp, a noise is not positive, the
            messages of a sensor differ in size, only some of them have a noise, two entries have the same name, an
            element is masked, all messages are before ``start``, or a driving sensor has no message in the time of the
            others.
        KeyError: if ``driving``, ``delays`` or ``origin`` name a sensor without messages.
        TypeError: for a ``dtype`` that is not floating.

    Example:
        >>> log = [(0.10, "lidar", [0.1]), (0.13, "gps", [1.0, 2.0], [4.0, 4.0]), (0.21, "lidar", [0.2])]
        >>> rows = message_rows(log, delays={"gps": 0.05}, start=0.0)
        >>> rows["stamp"].squeeze(-1)
        tensor([0.0000, 0.0800, 0.1000, 0.2100], dtype=torch.float64)
        >>> rows["gps_observed"].squeeze(-1), rows["gps_noise"][1]
        (tensor([False,  True, False, False]), tensor([4., 4.]))
    """
    dtype = dtype or torch.get_default_dtype()
    if not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
        raise TypeError(
            f"dtype must be floating, such as torch.float32, for steps are parts of a second; got {dtype!r}"
        )
    if unit not in SECONDS:
        raise ValueError(f"unit is one of {', '.join(map(repr, SECONDS))}, got {unit!r}")
    streams = _by_sensor(messages, unit)
    given = {"driving": driving, "delays": delays or {}, "origin": origin or {}, "rows_of": rows_of or ()}
    for what, names in given.items():
        unknown = [name for name in names if name not in streams]
        if unknown:
            raise KeyError(f"{what} names {unknown}, of which there is no message; there is {', '.join(streams)}.")
    for name, delay in (delays or {}).items():
        check_number(f"delay of {name!r}", delay)
        streams[name] = replace(streams[name], times=streams[name].times - delay)
    for name, stream in streams.items():
        if origin is not None and name in origin:
            streams[name] = stream = replace(
                stream, values=in_origin(stream.values, origin[name], f"origin of {name!r}")
            )
        labels = [f"{name}[{number}]" for number in range(stream.values.shape[1])]
        look_at_numbers(
            stream.values, labels, "the log", f"pass origin={{{name!r}: ...}} or dtype=torch.float64", dtype
        )
    if start is not None:
        check_number("start", start)
    first = min(stream.times[0] for stream in streams.values()) if start is None else float(start)
    if start is not None and first > (last := max(stream.times[-1] for stream in streams.values())):
        raise ValueError(f"start={start!r} is behind the last message, {last:.15g} s: pass an earlier one, or unit=.")
    drives = {name: streams.pop(name).once(name) for name in dict.fromkeys(driving)}
    if rows_of is not None and (silent := [name for name in streams if name not in rows_of]):
        raise ValueError(f"rows_of={list(rows_of)} leaves out {silent}, which do not drive the motion: name them, too.")
    heard = {name: stream.since(first) for name, stream in streams.items()}
    _look_at_gaps({**heard, **drives}, unit)
    for name, drive in drives.items():
        _look_at_silence(name, drive.times, np.concatenate([[], *(stream.times for stream in heard.values())]))
    stepping = [drive.since(first) for name, drive in drives.items() if rows_of is None or name in rows_of]
    events = [each.events() for each in (*heard.values(), *stepping)]
    moments, place = np.unique(np.concatenate(events), axis=0, return_inverse=True)
    times = np.concatenate([[first], moments[:, 0]])
    rows = {"stamp": times[:, None], "dt": np.diff(times, prepend=first)[:, None]}
    places = np.split(1 + place.reshape(-1), np.cumsum([len(each) for each in events]))
    written = [stream.rows(name, at, len(times)) for (name, stream), at in zip(heard.items(), places, strict=False)]
    for entries in (*written, *({name: drive.means(times)} for name, drive in drives.items())):
        if twice := rows.keys() & entries.keys():
            raise ValueError(f"{sorted(twice)} would be written twice: give the sensor of this name another one.")
        rows |= entries
    tensors = {name: torch.from_numpy(row) for name, row in rows.items()}
    kept = {name: row if name == "stamp" or row.dtype == torch.bool else row.to(dtype) for name, row in tensors.items()}
    return TensorDict(kept, [len(times)])


@dataclass(frozen=True)
class _Stream:
    """Messages of a sensor by time ``[m]``: values ``[m, O]``, and noise of each, if it reports one."""

    times: np.ndarray
    values: np.ndarray
    noise: np.ndarray | None

    def kept(self, which: np.ndarray) -> _Stream:
        """Returns the messages that a mask or index selects."""
        return _Stream(self.times[which], self.values[which], None if self.noise is None else self.noise[which])

    def since(self, first: float) -> _Stream:
        """Returns the messages from a time on."""
        return self.kept(self.times >= first)

    def once(self, name: str) -> _Stream:
        """Returns the last message of each time, without those that are not finite."""
        finite = self.kept(np.isfinite(self.values).all(1))
        if not len(finite.times):
            raise ValueError(f"{name!r} drives the motion and has no message that is finite.")
        return finite.kept(np.append(np.diff(finite.times) > 0, True))

    def events(self) -> np.ndarray:
        """Returns, for each message, its time and the number of earlier messages with the same time, ``[m, 2]``."""
        before = np.arange(len(self.times)) - np.searchsorted(self.times, self.times)
        return np.stack([self.times, before.astype(float)], 1)

    def rows(self, name: str, place: np.ndarray, count: int) -> dict[str, np.ndarray]:
        """Returns readings, their mask, and their noise, in their rows."""
        value, observed = np.full((count, *self.values.shape[1:]), np.nan), np.zeros((count, 1), bool)
        value[place], observed[place] = self.values, True
        found = {name: value, f"{name}_observed": observed}
        if self.noise is not None:
            matrix = self.noise.ndim > 2
            ones = np.eye(self.noise.shape[-1]) if matrix else np.ones(self.noise.shape[-1])
            found[f"{name}_noise"] = np.repeat(ones[None], count, 0)
            found[f"{name}_noise"][place] = self.noise
        return found

    def means(self, times: np.ndarray) -> np.ndarray:
        """Returns means between successive ``times`` of the linearly interpolated messages, ``[T, O]``."""
        now = np.stack([np.interp(times, self.times, column) for column in self.values.T], 1)
        knots = np.unique(np.concatenate([times, self.times]))
        on = np.stack([np.interp(knots, self.times, column) for column in self.values.T], 1)
        area = np.append(np.diff(knots)[:, None] * (on[1:] + on[:-1]) / 2, np.zeros_like(on[:1]), 0)
        # Each row has a sum of its own, instead of differences of one cumulative sum: an outlier affects no later row.
        total, step = np.add.reduceat(area, np.searchsorted(knots, times), 0)[:-1], np.diff(times)[:, None]
        now[1:] = np.where(step > 0, total / np.where(step > 0, step, 1.0), now[1:])
        return now


def _look_at_gaps(streams: Mapping[str, _Stream], unit: str) -> None:
    """Warns of gaps in the times of all sensors together; the warning names the sensor before the longest gap."""
    names = np.concatenate([np.repeat(name, len(stream.times)) for name, stream in streams.items()])
    times = np.concatenate([stream.times for stream in streams.values()])
    order = np.argsort(times, kind="stable")
    at = int(np.diff(times[order]).argmax()) if len(times) > 1 else 0
    look_at_times(times[order], "the log", str(names[order][at]) if len(times) else "", unit, ["gaps"])


def _look_at_silence(name: str, times: np.ndarray, others: np.ndarray) -> None:
    """Warns of gaps in a driving sensor while others have readings.

    Raises:
        ValueError: if it has no message in all of that time.
    """
    if not len(others):
        return
    begin, end = others.min(), others.max()
    if times[-1] < begin or times[0] > end:
        raise ValueError(
            f"{name!r} drives the motion from {times[0]:.15g} to {times[-1]:.15g} s, and has no message while the "
            f"others read, {begin:.15g} to {end:.15g} s: pass unit=, delays= or start=, or leave out "
            "what has another clock."
        )
    usual = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
    before, after = np.searchsorted(times, begin, "right") - 1, np.searchsorted(times, end)
    bounds = [begin] if before < 0 else [], times[max(before, 0) : after + 1], [end] if after == len(times) else []
    knots = np.concatenate(bounds)
    wide = np.flatnonzero(np.diff(knots) > _SILENT * usual)
    silent = [(float(knots[at]), float(knots[at + 1])) for at in wide]
    if silent:
        text = ", ".join(f"{start:.10g} to {stop:.10g} s" for start, stop in silent[:4])
        warn_of_log(
            "the log",
            name,
            f"drives the motion and says nothing in {len(silent)} stretches, {text}, where its steps are usually "
            f"{usual:.3g} s and the rows hold what it said before and after",
            "pass start=, leave out the messages of the others there, or take it as a sensor that is not driving",
        )


def _by_sensor(messages: Iterable[Sequence[Any]], unit: str) -> dict[str, _Stream]:
    """Returns the messages of each sensor, in the order of their stamps, s.

    Raises:
        ValueError: see :func:`message_rows`.
    """
    found: dict[str, list[tuple[float, np.ndarray, np.ndarray | None]]] = {}
    for number, message in enumerate(messages):
        if not hasattr(message, "__len__") or len(message) not in (3, 4) or not isinstance(message[1], str):
            raise ValueError(
                f"Message {number} is no (stamp, sensor, value) or (stamp, sensor, value, noise): {message!r}"
            )
        name, source = message[1], f"Message {number}, of {message[1]!r},"
        if any(np.ma.is_masked(part) for part in message):
            raise ValueError(f"{source} has masked elements: leave it out, or give the others a sensor of their own.")
        stamp = float(_floats(f"{source} has a stamp", message[0], 0)) * SECONDS[unit]
        value = np.atleast_1d(_floats(f"{source} has a value", message[2]))
        if not np.isfinite(stamp) or value.ndim != 1:
            raise ValueError(
                f"Message {number}, of {name!r}, has the stamp {stamp} and a value of {list(value.shape)}."
            )
        noise = message[3] if len(message) > 3 else None
        if noise is not None:
            noise = _floats(f"{source} has a noise", noise)
            _check_noise(f"Message {number}, of {name!r}, has a noise", noise, len(value))
        found.setdefault(name, []).append((stamp, value, noise))
    if not found:
        raise ValueError("There is no message.")
    for name, each in found.items():
        look_at_times(np.array([one[0] for one in each]), "the log", name, unit, ["late", "back", "steps"])
    return {name: _stream(name, sorted(each, key=lambda one: one[0])) for name, each in found.items()}


def _floats(what: str, given: Any, ndim: int | None = None) -> np.ndarray:
    try:
        array = np.asarray(given, float)
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: a tensor that requires a gradient
        array = None
    if given is None or array is None or array.ndim != (array.ndim if ndim is None else ndim):
        raise ValueError(f"{what} that is no number: {given!r}")
    return array


def _check_noise(what: str, noise: np.ndarray, size: int) -> None:
    square = noise.ndim == 2 and noise.shape[0] == noise.shape[1]
    if not (noise.ndim == 1 or square) or not 0 < len(noise) <= size:  # tangents may have fewer components than points
        raise ValueError(f"{what} of {list(noise.shape)}: give variances [O] or a covariance [O, O].")
    least = np.linalg.eigvalsh(noise).min() if square else noise.min()  # eigvalsh reads one triangle only
    scale = np.sqrt(np.outer(noise.diagonal(), noise.diagonal())) if least > 0 and square else 1.0
    if not least > 0 or (square and not (abs(noise - noise.T) <= 1e-4 * scale).all()):
        raise ValueError(
            f"{what} that is none: variances are positive, a covariance is symmetric and positive definite; got "
            f"{noise.tolist()}."
        )


def _stream(name: str, messages: list[tuple[float, np.ndarray, np.ndarray | None]]) -> _Stream:
    stamps, values, noises = zip(*messages, strict=True)
    shapes = {
        (value.shape, None if noise is None else noise.shape) for value, noise in zip(values, noises, strict=True)
    }
    if len(shapes) > 1:
        sizes = ", ".join(
            f"{list(value)} with noise {noise and list(noise)}" for value, noise in sorted(shapes, key=str)
        )
        raise ValueError(f"The messages of {name!r} differ in size: {sizes}.")
    return _Stream(np.array(stamps), np.stack(values), None if noises[0] is None else np.stack(noises))
