"""Filter of an inertial sensor's orientation, with acceleration and magnetic disturbances in the state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from torch_denkf._checks import check_number
from torch_denkf.functional.manifolds import SO3, Euclidean, Opposite, Product, rotate
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import ConstantNoise, GaussianAround, Select
from torch_denkf.motions.motion import Motion
from torch_denkf.submodel import Sensor, SubModel

__all__ = ["SPACE", "ImuFilter", "ImuMotion", "ImuNoise", "ImuSettings", "MagnetometerNoise", "imu", "moves"]

#: Orientation (errors in the world's axes); the gyro's bias and its matrix of errors; position, velocity and
#: acceleration in the body's axes; the magnetometer's bias; the field northwards and upwards; the magnetometer's lag;
#: the stray field in the body's axes; the lever, likewise. In the world's axes, the error of the heading would stand in
#: what the accelerometer reads of acceleration, and the filter would learn a heading from it that nothing reads.
SPACE = Product(Opposite(SO3()), *map(Euclidean, (3, 9, 3, 3, 3, 3, 2, 1, 3, 3)))
BIAS, FIELD = 4, 28  # their places in a point


@dataclass(frozen=True)
class ImuSettings:
    """Settings of an :class:`ImuFilter`.

    Attributes:
        gyro: density of the gyro's white noise in rad/s/sqrt(Hz).
        gyro_rate: increase of ``gyro`` per rad/s of rotation.
        gyro_walk: random walk of the gyro's bias, in rad/s^2/sqrt(Hz).
        gyro_bias: initial standard deviation of that bias, in rad/s.
        gyro_scale: standard deviation of the gyro's scale factor errors.
        gyro_skew: standard deviation of the gyro's axis misalignments, in rad.
        poles: the three rates, in 1/s, of the process whose output is the position of the body about a place.
        motion: standard deviation that sets the size of the acceleration of a resting body, in m/s^2.
        motion_unrest: increase of ``motion`` per m/s^2 of ``"unrest"``.
        motion_start: initial standard deviation of position, velocity and acceleration.
        accelerometer: standard deviation of the mean over a block, in m/s^2.
        magnetometer: standard deviation of the mean over a block, in uT.
        magnetometer_rate: increase of ``magnetometer`` per rad/s of rotation.
        magnetic_bias: initial standard deviation of the magnetometer's bias, in uT.
        magnetic_walk: random walk of that bias, in uT/sqrt(s).
        field: standard deviation of the first reading of the magnetic field, in uT.
        field_walk: random walk of the field, in uT/sqrt(s).
        stray: standard deviation of the time-varying stray field along each axis, in uT.
        stray_unrest: increase of ``stray`` per uT of ``"disturbance"``.
        stray_time: time constant of the stray field, in s.
        lag: delay of the magnetometer relative to the gyro, in s.
        lag_std: standard deviation of ``lag``.
        lever: initial standard deviation of the lever arm along each axis, in m: a hand-held sensor rotates about a
            joint, so that its acceleration follows from its rotation.
        lever_walk: random walk of the lever arm, in m/sqrt(s).
        tilt: initial standard deviation of the inclination, in rad.
        heading: initial standard deviation of the heading, in rad.
        rest: standard deviation of the gyro's mean over a block at rest, in rad/s.
        gravity: in m/s^2.
        block: duration of the readings of one step, in s.
        latency: delay between readings and their time stamps, in s; orientations are predicted by it.
        heading_scale: factor on the standard deviation of the heading, which sets the coverage.
        heading_floor: least standard deviation of the heading, in degrees.
        tilt_scale: factor on the standard deviations of the inclination.
        tilt_floor: least standard deviation of the inclination about each axis, in degrees.
        place: north and up components of the local earth's field, in uT, if known. The heading's standard deviation
            increases with the deviation of the estimated field from them, as an unknown east component is as likely.
    """

    gyro: float = 1e-3
    gyro_rate: float = 1e-3
    gyro_walk: float = 1e-4
    gyro_bias: float = 0.01
    gyro_scale: float = 0.003
    gyro_skew: float = 0.003
    poles: tuple[float, ...] = (1.0, 1.5, 15.0)
    motion: float = 0.05
    motion_unrest: float = 1.0
    motion_start: float = 0.1
    accelerometer: float = 0.05
    magnetometer: float = 4.0
    magnetometer_rate: float = 0.3
    magnetic_bias: float = 0.3
    magnetic_walk: float = 0.01
    field: float = 3.0
    field_walk: float = 0.02
    stray: float = 0.5
    stray_unrest: float = 0.5
    stray_time: float = 1.0
    lag: float = 0.0
    lag_std: float = 0.003
    lever: float = 0.1
    lever_walk: float = 0.01
    tilt: float = 0.05
    heading: float = 0.1
    rest: float = 0.002
    gravity: float = 9.82
    block: float = 0.05
    latency: float = 0.0
    heading_scale: float = 1.0
    heading_floor: float = 0.5
    tilt_scale: float = 0.7
    tilt_floor: float = 0.15
    place: tuple[float, float] | None = None

    def __post_init__(self):
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name in ("poles", "place") and value is not None:  # of a file they are lists
                value = tuple(value)
                object.__setattr__(self, each.name, value)
                size = 3 if each.name == "poles" else 2
                if len(value) != size:
                    raise ValueError(f"{each.name} are {size} numbers; got {len(value)}.")
            for number in value if isinstance(value, tuple) else [] if value is None else [value]:
                check_number(each.name, number, above=-math.inf if each.name in ("lag", "latency", "place") else 0)


class ImuMotion(Motion):
    r"""Rotates the orientation by the gyro, and moves the body about a fixed point.

    The gyro reads :math:`\omega + b + M \tilde\omega`. The position is the output of a linear process of third order
    with white noise at its input, so that velocity and position stay bounded: the mean of the accelerometer over long
    times is gravity. ``"moves"`` ``[*B, 9]`` is that process' transition matrix, see :func:`moves`. The stray field
    fades.

    Args:
        stray_time: time constant of the stray field, in s.
    """

    stray_time: Tensor

    def __init__(self, stray_time: float):
        super().__init__(SPACE, "dt", {"gyro": 3, "moves": 9}, ("belief", "ensemble"), ("forecast", "ensemble"))
        self.register_buffer("stray_time", torch.tensor(stray_time))

    def move(self, state, gyro, moves, *, dt):
        """Returns the state after one step."""
        orientation, bias, errors, position, velocity, acceleration, *others, stray, lever = SPACE.points(state)
        turn = SO3().exp((gyro - bias - (errors.unflatten(-1, (3, 3)) * gyro.unsqueeze(-2)).sum(-1)) * dt)
        matrix, before = moves.unflatten(-1, (3, 3)), torch.stack([position, velocity, acceleration], -2)
        moved = (matrix.unsqueeze(-1) * before.unsqueeze(-3)).sum(-2)
        stray = stray * (-dt / self.stray_time).exp()
        *moved, stray = (rotate(turn, vector, back=True) for vector in (*moved.unbind(-2), stray))
        return torch.cat([SO3().compose(orientation, turn), bias, errors, *moved, *others, stray, lever], -1)


def moves(poles: Sequence[float], dt: float) -> Tensor:
    """Returns the transition of position, velocity and acceleration in a step, row by row, ``[9]`` in float64.

    Args:
        poles: rates of the process in 1/s.
        dt: of a step, in s.

    Example:
        >>> moves((1.0, 2.0, 3.0), 0.0).tolist()
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    """
    a, b, c = poles
    rates = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-a * b * c, -a * b - a * c - b * c, -a - b - c]]
    return torch.linalg.matrix_exp(dt * torch.tensor(rates, dtype=torch.float64)).flatten()


class ImuNoise(SubModel):
    """Process noise variances ``[*B, 36]``, learnable: of the gyro, the motion's acceleration and slow errors.

    Args:
        settings: the numbers before training.
    """

    def __init__(self, settings: ImuSettings):
        keys = [("belief", "mean"), "gyro", "unrest", "disturbance", "dt"]
        super().__init__(nn.Identity(), keys, [("forecast", "noise")])
        s = settings
        shares = [s.gyro, s.gyro_rate, s.gyro_walk, s.motion, s.motion_unrest, s.magnetic_walk, s.field_walk]
        shares += [s.stray, s.stray_unrest, s.lever_walk]
        self.log_std = nn.Parameter(torch.tensor(shares).log())
        self.register_buffer("damping", torch.tensor(2 * sum(s.poles)))
        self.register_buffer("stray_time", torch.tensor(s.stray_time))

    def compute(self, mean, gyro, unrest, disturbance, dt):
        """Returns the variances of the step."""
        rate, variance = gyro.square().sum(-1, keepdim=True), (2 * self.log_std).exp()
        white, by_rate, walk, motion, by_unrest, bias, field, stray, by_disturbance, lever = variance.unbind(-1)
        turn, push = white + by_rate * rate, self.damping * (motion + by_unrest * unrest.square())
        new = (stray + by_disturbance * disturbance.square()) * -torch.expm1(-2 * dt / self.stray_time) / dt
        sizes = ((turn, 3), (walk, 3), (0, 15), (push, 3), (bias, 3), (field, 2), (0, 1), (new, 3), (lever, 3))
        columns = [(one + torch.zeros_like(dt)).expand(*dt.shape[:-1], count) for one, count in sizes]
        return (torch.cat(columns, -1) * dt).to(mean.dtype)


class _Accelerometer(SubModel):
    """Specific force in the body's axes ``[*B, E, 3]``."""

    def __init__(self, gravity: float):
        super().__init__(nn.Identity(), [("forecast", "ensemble"), "lever"], [("forecast", "observation")])
        self.register_buffer("up", torch.tensor([0.0, 0.0, gravity]))

    def compute(self, state, lever):
        """Sums gravity and accelerations of and about the joint; ``lever`` ``[*B, 9]``, see :func:`imu_rows`."""
        parts = SPACE.points(state)
        about = (lever.unflatten(-1, (3, 3)).unsqueeze(-3) * parts[10].unsqueeze(-2)).sum(-1)
        return rotate(parts[0], self.up, back=True) + parts[5] + about


class _Magnetometer(SubModel):
    """Magnetometer readings, delayed relative to the gyro: ``[*B, E, 3]``."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble"), "gyro"], [("forecast", "observation")])

    def compute(self, state, gyro):
        """Sums the field, in the axes of the body when it was read, and the bias."""
        orientation, *_, bias, field, lag, stray, _ = SPACE.points(state)
        field = rotate(orientation, torch.nn.functional.pad(field, (1, 0)), back=True) + stray
        return field + lag * torch.linalg.cross(gyro.unsqueeze(-2).expand_as(field), field) + bias


class MagnetometerNoise(Sensor):
    """Variances ``[*B, 3]`` of the magnetometer, learnable; they increase with the rate of rotation.

    Args:
        settings: the numbers before training.
    """

    observation_dim = 3

    def __init__(self, settings: ImuSettings):
        super().__init__(nn.Identity(), ["gyro"], [("sensor", "noise")])
        self.log_std = nn.Parameter(torch.tensor([settings.magnetometer, settings.magnetometer_rate]).log())

    def compute(self, gyro):
        """Returns the variances."""
        white, rate = (2 * self.log_std).exp().unbind(-1)
        return (white + rate * gyro.square().sum(-1, keepdim=True)).expand_as(gyro)


class ImuFilter(FusedFilter):
    """A right-invariant extended Kalman filter of an inertial sensor's orientation, built by :func:`imu`.

    It reads the rows that :func:`~torch_denkf.applications.imu.imu_rows` makes of a log. The state is a point of
    ``SPACE``: its first four numbers are the quaternion from the sensor's axes to the world's (east, north, up, north
    as the magnetometer says).

    Args:
        settings: its numbers.

    Attributes:
        builder: name of the function that builds it, in a saved folder.
        settings: its numbers.
    """

    builder = "imu"

    def __init__(self, settings: ImuSettings):
        s = settings
        start = [s.tilt] * 2 + [s.heading] + [s.gyro_bias] * 3
        start += [s.gyro_scale if row == column else s.gyro_skew for row in range(3) for column in range(3)]
        start += [s.motion_start] * 9 + [s.magnetic_bias] * 3 + [s.field] * 2 + [s.lag_std] + [s.stray] * 3
        start += [s.lever] * 3
        force_noise = ConstantNoise([s.accelerometer] * 3, trainable=True, in_key="accelerometer")
        sensors = {
            "accelerometer": FusedSensor(_Accelerometer(s.gravity), force_noise),
            "magnetometer": FusedSensor(_Magnetometer(), MagnetometerNoise(s)),
            "rest": FusedSensor(Select(range(BIAS, BIAS + 3)), [s.rest] * 3, observation_key="gyro"),
        }
        super().__init__(
            ImuMotion(s.stray_time),
            sensors,
            initial=GaussianAround(start, state_key="start", space=SPACE),
            process_noise=ImuNoise(s),
            update_at_reset=True,
        )
        self.settings = settings


def imu(**settings) -> ImuFilter:
    """Returns a filter of an inertial sensor's orientation, with 9 or 6 axes.

    Args:
        **settings: those of :class:`ImuSettings`.

    Raises:
        TypeError: on a name that is no setting.
        ValueError: on a number that is not positive.

    Example:
        >>> from torch_denkf.applications.imu import orientations
        >>> still = {"gyro": torch.zeros(500, 3), "acceleration": torch.tensor([0.0, 0.0, 9.82]).expand(500, 3)}
        >>> found = orientations(imu(), **still, rate=100.0)
        >>> found.quaternion[-1], found.std.shape
        (tensor([1., 0., 0., 0.]), torch.Size([500, 3]))
    """
    return ImuFilter(ImuSettings(**settings))
