"""Log of an inertial sensor: inputs of the filter, and an orientation for each reading."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf._checks import check_number, check_shape
from torch_denkf.applications.imu.filter import FIELD, SPACE, ImuFilter, ImuSettings, moves
from torch_denkf.functional.manifolds import SO3, quaternion_of, rotate, rotation_matrix
from torch_denkf.smoothers import RTSSmoother

__all__ = ["Orientations", "imu_rows", "orientations"]

SLOW, UNREST, STILL, REST = 2.0, 1.0, 0.5, 1.5  # s: of means, of their squared deviations, of rest, of its length
RATE, CHANGE, PUSH = 0.0349, 0.01745, 0.3  # at rest: rad/s, and deviations in rad/s and m/s^2 from the last half second


class Orientations(NamedTuple):
    """Orientations of a log.

    Attributes:
        quaternion: ``[T, 4]``, w first, from the sensor's axes to the world's.
        std: standard deviations of rotations about the world's x, y and z, ``[T, 3]`` in rad: inclination about two
            axes, and heading.
        mean: the filter's beliefs, a point of its space for each block, ``[N, 37]``.
        cov: their covariances ``[N, 36, 36]``.
    """

    quaternion: Tensor
    std: Tensor
    mean: Tensor
    cov: Tensor


def imu_rows(
    settings: ImuSettings, gyro: Tensor, acceleration: Tensor, magnetometer: Tensor | None = None, *, rate: float
) -> TensorDict:
    """Makes the rows of :class:`ImuFilter` from a log: means of blocks of readings, in the axes at a block's end.

    The rotation within a block is exact: the gyro's readings are integrated one by one, and accelerometer and
    magnetometer are turned to the block's end before their mean is taken.

    Args:
        settings: of the filter.
        gyro: ``[T, 3]`` in rad/s, finite.
        acceleration: ``[T, 3]`` in m/s^2; rows with NaN are missing.
        magnetometer: ``[T, 3]`` in uT, likewise; ``None`` for 6 axes.
        rate: readings per second.

    Returns:
        Rows ``[N]``; readings after the last whole block are dropped.

    Raises:
        ValueError: if shapes or units are wrong, a gyro's reading is not finite, or there is no whole block.
    """
    check_number("rate", rate, least=10, cure="It is readings a second; stamps are in s, and not in ms")
    for name, value in (("gyro", gyro), ("acceleration", acceleration), ("magnetometer", magnetometer)):
        if value is not None:
            check_shape(name, value, [len(gyro), 3], "[T, 3]")
    if not gyro.isfinite().all():
        raise ValueError("gyro has readings that are not finite; fill short gaps by interpolation, or cut the log.")
    size = acceleration.norm(dim=-1).nanmedian().item()
    if not 5 < size < 20:
        raise ValueError(f"acceleration is in m/s^2, where gravity is 9.81; the median of its size is {size:.3g}.")
    size = math.nan if magnetometer is None else magnetometer.norm(dim=-1).nanmedian().item()
    if size < 5 or size > 500:
        raise ValueError(f"magnetometer is in uT, where the earth's field has 25 to 65; the median is {size:.3g}.")
    count, dt = block_size(settings, rate), 1 / rate
    faster = torch.cat([torch.zeros_like(gyro[:1]), gyro.diff(dim=0)]) * rate
    blocks = len(gyro) // count
    if not blocks:
        raise ValueError(f"a log needs at least {count} readings, one block of {settings.block} s; got {len(gyro)}.")
    gyro, faster, force = (
        value[: blocks * count].unflatten(0, (blocks, count)) for value in (gyro, faster, acceleration)
    )
    turns, to_end = SO3().exp(gyro * dt), [SO3().neutral(gyro).expand(blocks, 4)]
    for place in range(count - 1, 0, -1):
        to_end.append(SO3().compose(turns[:, place], to_end[-1]))
    back = SO3().inverse(torch.stack(to_end[::-1], 1))
    total = SO3().compose(turns[:, 0], to_end[-1])
    rows = TensorDict({"gyro": SO3().log(total) / (count * dt), "dt": gyro.new_full((blocks, 1), count * dt)}, [blocks])
    rows["moves"] = moves(settings.poles, count * dt).to(gyro).expand(blocks, 9)
    rows["accelerometer"], rows["accelerometer_observed"] = _mean(rotate(back, force))
    lever = []  # acceleration of a point that turns with the body, by its distance along each axis
    for axis in torch.eye(3).to(gyro).expand(blocks, count, 3, 3).unbind(-2):
        lever.append(rotate(back, gyro.cross(gyro.cross(axis, -1), -1) + faster.cross(axis, -1)).mean(1))
    rows["lever"] = torch.stack(lever, -1).flatten(-2)
    if magnetometer is None:
        rows["magnetometer"] = torch.zeros_like(rows["gyro"])
        rows["magnetometer_observed"] = torch.zeros_like(rows["accelerometer_observed"])
    else:
        field = magnetometer[: blocks * count].unflatten(0, (blocks, count))
        field = rotate(SO3().exp(-gyro * settings.lag), field)
        rows["magnetometer"], rows["magnetometer_observed"] = _mean(rotate(back, field))
    turned = _running_product(total)
    for name, of in (("unrest", "accelerometer"), ("disturbance", "magnetometer")):
        still = rotate(turned, rows[of])  # in axes that the gyro alone keeps
        away = (still - _running_mean(still, rows["dt"], SLOW)).square().mean(-1, keepdim=True)
        rows[name] = _running_mean(away, rows["dt"], UNREST).clamp_min(0).sqrt()
    calm = rows["gyro"].norm(dim=-1, keepdim=True) < RATE
    for name, limit in (("gyro", CHANGE), ("accelerometer", PUSH)):
        away = rows[name] - _running_mean(rows[name], rows["dt"], STILL)
        calm &= away.norm(dim=-1, keepdim=True) < limit
    long = int(REST / (count * dt)) + 1
    calm_rows = torch.nn.functional.pad(calm.squeeze(-1).long().cumsum(0), (long, 0))
    rows["rest_observed"] = (calm_rows[long:] - calm_rows[:-long] == long).unsqueeze(-1)
    rows["start"] = _start(rows).expand(blocks, -1)
    return rows


@torch.no_grad()
def orientations(
    model: ImuFilter,
    gyro: Tensor,
    acceleration: Tensor,
    magnetometer: Tensor | None = None,
    *,
    rate: float,
    smooth: bool = False,
) -> Orientations:
    """Filters a log, and returns an orientation with standard deviations for each reading.

    Within a block the last belief is rotated by the gyro; its standard deviations are unchanged.

    Args:
        model: of :func:`imu`, or ``from_pretrained("imu")``.
        gyro: ``[T, 3]`` in rad/s.
        acceleration: ``[T, 3]`` in m/s^2.
        magnetometer: ``[T, 3]`` in uT; ``None`` for 6 axes, with an initial heading of north.
        rate: readings per second.
        smooth: whether to smooth (Rauch-Tung-Striebel).

    Raises:
        ValueError: see :func:`imu_rows`; or if the gyro's readings are in degrees a second.
    """
    settings, dtype = model.settings, next(model.parameters()).dtype
    values = [None if value is None else value.to(dtype) for value in (gyro, acceleration, magnetometer)]
    rows = imu_rows(settings, *values, rate=rate)  # type: ignore[arg-type]
    _check_unit_of(values[0], values[1], rate)  # type: ignore[arg-type]
    if smooth:
        found = RTSSmoother(model).sequence(rows, keep=[])["smoothed"]
    else:
        found = model.sequence(rows, keep=[("belief", "mean"), ("belief", "cov")])["belief"]
    return at_readings(settings, found["mean"], found["cov"], values[0], rate)  # type: ignore[arg-type]


def at_readings(settings: ImuSettings, mean: Tensor, cov: Tensor, gyro: Tensor, rate: float) -> Orientations:
    """Returns orientations at the readings of a log, from the beliefs at the ends of its blocks."""
    count, length = block_size(settings, rate), len(gyro)
    blocks = len(mean) + 1  # the last may be short
    rates = torch.nn.functional.pad(gyro, (0, 0, 0, blocks * count - length)).unflatten(0, (blocks, count))
    before = torch.cat([mean[:1], mean])  # what the readings of a block start from
    bias, errors = SPACE.points(before)[1:3]
    rates = rates - bias.unsqueeze(1) - rates @ errors.unflatten(-1, (3, 3)).mT
    turns = SO3().exp(rates / rate)
    steps = [turns[:, 0]]
    for place in range(1, count):
        steps.append(SO3().compose(steps[-1], turns[:, place]))
    begin = before[:, :4].clone()
    begin[0] = SO3().compose(mean[0, :4], SO3().inverse(steps[-1][0]))
    found = SO3().compose(begin.unsqueeze(1), torch.stack(steps, 1))
    found[:-1, -1] = mean[:, :4]
    found = SO3().compose(found, SO3().exp(rates * settings.latency))
    variance = cov.diagonal(dim1=-2, dim2=-1)[:, :3]
    degree = torch.pi / 180
    scale = variance.new_tensor([settings.tilt_scale] * 2 + [settings.heading_scale])
    floor = variance.new_tensor([settings.tilt_floor] * 2 + [settings.heading_floor]) * degree
    std = (variance * scale.square() + floor.square() + astray(settings, mean)).sqrt()
    std = torch.cat([std[:1], std]).unsqueeze(1).repeat(1, count, 1)
    std[:-1, -1] = std[1:, 0].clone()
    return Orientations(found.flatten(0, 1)[:length], std.flatten(0, 1)[:length], mean, cov)


def _check_unit_of(gyro: Tensor, acceleration: Tensor, rate: float) -> None:
    """Raises if gravity is consistent with the gyro in degrees per second, but not in rad/s."""
    count = max(round(rate), 1)
    seconds = len(gyro) // count
    force = torch.where(acceleration.isfinite().all(-1, keepdim=True), acceleration, 0)
    turns = gyro[: seconds * count].norm(dim=-1).reshape(seconds, count).mean(1) > 0.5

    def size(gyro: Tensor) -> float:
        kept = rotate(_running_product(SO3().exp(gyro / rate)), force)[: seconds * count]
        return kept.unflatten(0, (seconds, count)).mean(1).norm(dim=-1)[turns].median().item()

    if turns.any() and size(gyro) < 7 and size(gyro * torch.pi / 180) > 9:
        raise ValueError(
            "gyro is in rad/s; by these readings gravity turns with the body, and would not if they were in degrees/s: "
            "multiply them by pi / 180."
        )


def astray(settings: ImuSettings, mean: Tensor) -> Tensor:
    """Returns added variances ``[N, 3]``: of the heading by the field's deviation from the local one, else zero."""
    field = mean[:, FIELD : FIELD + 2]
    if settings.place is None or not field.any():  # or 6 axes
        return mean.new_zeros(3)
    away = (field - field.new_tensor(settings.place)).square().mean(-1) / field[:, 0].square().clamp_min(1.0)
    return torch.nn.functional.pad(away.unsqueeze(-1), (2, 0))


def block_size(settings: ImuSettings, rate: float) -> int:
    """Returns the number of readings in a block."""
    return max(1, round(settings.block * rate))


def _mean(readings: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the means of blocks ``[N, K, 3]`` over the available readings, and the mask ``[N, 1]``."""
    known = readings.isfinite().all(-1, keepdim=True)
    total = torch.where(known, readings, 0).sum(1) / known.sum(1).clamp_min(1)
    return total, known.any(1)


def _running_mean(values: Tensor, dt: Tensor, time: float) -> Tensor:
    """Returns exponentially weighted running means ``[N, K]``, initialised by the first row."""
    keep = (-dt[0, 0] / time).exp()
    found, step = torch.cat([values[:1], (1 - keep) * values[1:]]), 1
    while step < len(values):
        found = torch.cat([found[:step], found[step:] + keep**step * found[:-step]])
        step *= 2
    return found


def _running_product(turns: Tensor) -> Tensor:
    """Returns the cumulative products of the rotations ``[N, 4]`` after the first."""
    found, step = torch.cat([SO3().neutral(turns).unsqueeze(0), turns[1:]]), 1
    while step < len(turns):
        found = torch.cat([found[:step], SO3().compose(found[:-step], found[step:])])
        step *= 2
    return found


def _start(rows: TensorDict) -> Tensor:
    """Returns the initial state by the first readings of accelerometer and magnetometer; without one, north is x."""
    first = rows["accelerometer_observed"].squeeze(-1).long().argmax()
    up = rows["accelerometer"][first]
    up = up / up.norm()
    seen = rows["magnetometer_observed"][first].item()
    field = rows["magnetometer"][first] if seen else torch.eye(3, dtype=up.dtype)[up.abs().argmin()]
    east = torch.linalg.cross(field, up)
    east = east / east.norm()
    axes = torch.stack([east, torch.linalg.cross(up, east), up])
    if not seen:  # heading zero: the body's x as far as it is level
        axes = rotation_matrix(_level(up))
    state = SPACE.neutral(up)
    state[:4] = quaternion_of(axes)
    state[FIELD : FIELD + 2] = (axes @ field)[1:] if seen else 0
    return state


def _level(up: Tensor) -> Tensor:
    """Returns the shortest rotation of the body that takes ``up`` to the world's z."""
    z = torch.tensor([0.0, 0.0, 1.0], dtype=up.dtype)
    axis, angle = torch.linalg.cross(up, z), torch.acos(up[2].clamp(-1, 1))
    size = axis.norm()
    if size < 1e-6:  # upright, or on its head
        axis, size = torch.tensor([1.0, 0.0, 0.0], dtype=up.dtype), torch.ones((), dtype=up.dtype)
    return SO3().exp(axis / size * angle)
