"""A log of messages as rows that a filter reads: each at its own time, none moved to a clock."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf._checks import check_number

__all__ = ["message_rows"]


def message_rows(
    messages: Iterable[Sequence[Any]],
    *,
    driving: Sequence[str] = (),
    delays: Mapping[str, float] | None = None,
    start: float | None = None,
    dtype: torch.dtype | None = None,
) -> TensorDict:
    """Rows ``[T]`` of a log in which sensors of different rates write when they like.

    Each time at which a sensor has read is a row, and ``"dt"`` ``[T, 1]`` holds the seconds since the row before: the
    motion must read it. The first row is the start of the filter; no message stands there. A sensor that says two
    things about one time gets two rows, the second with a ``dt`` of zero.

    A sensor's reading stands under its name, ``[T, O]``, and its mask under NAME_observed, as
    :class:`~torch_denkf.fusion.FusedSensor` expects them; rows without one hold NaN. Where messages bring their noise,
    that stands under NAME_noise: the name to give to ``FusedSensor(noise=...)``.

    Args:
        messages: ``(stamp, sensor, value)`` or ``(stamp, sensor, value, noise)``, in any order: the stamp in seconds,
            the sensor's name, ``[O]`` numbers, and the reading's variances ``[O]`` or covariance ``[O, O]``,
            of tangents where it is a point of a space.
        driving: sensors that drive the motion, such as ``"imu"``. They have no mask: each row holds the mean since the
            row before, on straight lines between the messages, each of which counts for the moment of its stamp; before
            the first and behind the last it stays as it is there. Messages of them that are not finite are left out.
        delays: by how many seconds a sensor's stamps are later than what it saw, by name.
        start: time of the first row, in seconds; by default that of the first reading. What was read before is left
            out.
        dtype: of the numbers; torch's default.

    Returns:
        The rows, with ``"stamp"`` ``[T, 1]`` in float64.

    Raises:
        ValueError: if there is no message, one is malformed or has no finite stamp, a noise is not positive, the
            messages of a sensor differ in size, only some of them bring a noise, or two entries have one name.
        KeyError: if ``driving`` or ``delays`` name a sensor that has no message.

    Example:
        >>> log = [(0.10, "lidar", [0.1]), (0.13, "gps", [1.0, 2.0], [4.0, 4.0]), (0.21, "lidar", [0.2])]
        >>> rows = message_rows(log, delays={"gps": 0.05}, start=0.0)
        >>> rows["stamp"].squeeze(-1)
        tensor([0.0000, 0.0800, 0.1000, 0.2100], dtype=torch.float64)
        >>> rows["gps_observed"].squeeze(-1), rows["gps_noise"][1]
        (tensor([False,  True, False, False]), tensor([4., 4.]))
    """
    streams = _by_sensor(messages)
    for what, names in (("driving", driving), ("delays", delays or {})):
        unknown = [name for name in names if name not in streams]
        if unknown:
            raise KeyError(f"{what} names {unknown}, of which there is no message; there is {', '.join(streams)}.")
    for name, delay in (delays or {}).items():
        check_number(f"delay of {name!r}", delay)
        streams[name] = replace(streams[name], times=streams[name].times - delay)
    if start is not None:
        check_number("start", start)
    first = min(stream.times[0] for stream in streams.values()) if start is None else float(start)
    drives = {name: streams.pop(name).once() for name in dict.fromkeys(driving)}
    heard = {name: stream.since(first) for name, stream in streams.items()}
    events = [each.events() for each in (*heard.values(), *(drive.since(first) for drive in drives.values()))]
    moments, place = np.unique(np.concatenate(events), axis=0, return_inverse=True)
    times = np.concatenate([[first], moments[:, 0]])
    rows = {"stamp": times[:, None], "dt": np.diff(times, prepend=first)[:, None]}
    places = np.split(1 + place.reshape(-1), np.cumsum([len(each) for each in events]))
    written = [stream.rows(name, at, len(times)) for (name, stream), at in zip(heard.items(), places, strict=False)]
    for entries in (*written, *({name: drive.means(times)} for name, drive in drives.items())):
        if twice := rows.keys() & entries.keys():
            raise ValueError(f"{sorted(twice)} would be written twice: give the sensor of this name another one.")
        rows |= entries
    dtype = dtype or torch.get_default_dtype()
    tensors = {name: torch.from_numpy(row) for name, row in rows.items()}
    kept = {name: row if name == "stamp" or row.dtype == torch.bool else row.to(dtype) for name, row in tensors.items()}
    return TensorDict(kept, [len(times)])


@dataclass(frozen=True)
class _Stream:
    """What a sensor said, in the order of its times ``[m]``: values ``[m, O]``, and noise of each, if it says so."""

    times: np.ndarray
    values: np.ndarray
    noise: np.ndarray | None

    def kept(self, which: np.ndarray) -> _Stream:
        """The messages at some places."""
        return _Stream(self.times[which], self.values[which], None if self.noise is None else self.noise[which])

    def since(self, first: float) -> _Stream:
        """The messages from a time on."""
        return self.kept(self.times >= first)

    def once(self) -> _Stream:
        """The last message of each time, without those that are not finite."""
        finite = self.kept(np.isfinite(self.values).all(1))
        if not len(finite.times):
            raise ValueError("A sensor that drives the motion has no message that is finite.")
        return finite.kept(np.append(np.diff(finite.times) > 0, True))

    def events(self) -> np.ndarray:
        """Of each message its time, and how many of the same sensor and time stand before it, ``[m, 2]``."""
        before = np.arange(len(self.times)) - np.searchsorted(self.times, self.times)
        return np.stack([self.times, before.astype(float)], 1)

    def rows(self, name: str, place: np.ndarray, count: int) -> dict[str, np.ndarray]:
        """Readings, their mask, and their noise, in the rows in which they stand."""
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
        """Means between each of the ``times`` and the one before, on straight lines between the messages ``[T, O]``."""
        now = np.stack([np.interp(times, self.times, column) for column in self.values.T], 1)
        knots = np.unique(np.concatenate([times, self.times]))
        on = np.stack([np.interp(knots, self.times, column) for column in self.values.T], 1)
        area = np.append(np.diff(knots)[:, None] * (on[1:] + on[:-1]) / 2, np.zeros_like(on[:1]), 0)
        # Each row sums its own pieces: one reading that is absurd must not spoil the rows that follow.
        total, step = np.add.reduceat(area, np.searchsorted(knots, times), 0)[:-1], np.diff(times)[:, None]
        now[1:] = np.where(step > 0, total / np.where(step > 0, step, 1.0), now[1:])
        return now


def _by_sensor(messages: Iterable[Sequence[Any]]) -> dict[str, _Stream]:
    """The messages of each sensor, in the order of their stamps.

    Raises:
        ValueError: see :func:`message_rows`.
    """
    found: dict[str, list[tuple[float, np.ndarray, np.ndarray | None]]] = {}
    for number, message in enumerate(messages):
        if len(message) not in (3, 4) or not isinstance(message[1], str):
            raise ValueError(
                f"Message {number} is no (stamp, sensor, value) or (stamp, sensor, value, noise): {message!r}"
            )
        stamp, name, value = float(message[0]), message[1], np.atleast_1d(np.asarray(message[2], float))
        if not np.isfinite(stamp) or value.ndim != 1:
            raise ValueError(
                f"Message {number}, of {name!r}, has the stamp {stamp} and a value of {list(value.shape)}."
            )
        noise = np.asarray(message[3], float) if len(message) > 3 and message[3] is not None else None
        if noise is not None:
            _check_noise(f"Message {number}, of {name!r}, has a noise", noise, len(value))
        found.setdefault(name, []).append((stamp, value, noise))
    if not found:
        raise ValueError("There is no message.")
    return {name: _stream(name, sorted(each, key=lambda one: one[0])) for name, each in found.items()}


def _check_noise(what: str, noise: np.ndarray, size: int) -> None:
    square = noise.ndim == 2 and noise.shape[0] == noise.shape[1]
    if not (noise.ndim == 1 or square) or not 0 < len(noise) <= size:  # a tangent may have fewer numbers than a point
        raise ValueError(f"{what} of {list(noise.shape)}: give variances [O] or a covariance [O, O].")
    least = np.linalg.eigvalsh(noise).min() if square else noise.min()  # it reads one triangle alone
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
