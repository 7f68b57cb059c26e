"""The library's filters of orientations, by gyro and accelerometer, and with a few more readings."""

from __future__ import annotations

from functools import partial
from typing import Literal

import torch
from tensordict import TensorDict
from torch import nn

from benchmarks.attitude.task import DT, FIELD, GRAVITY, Sensors
from torch_denkf import EKF, UKF, DEnKF, Filter, FusedFilter, FusedSensor
from torch_denkf.functional.manifolds import SO3, Space, rotate
from torch_denkf.modules import AroundState, ConstantNoise, EnsembleAnalysis, GaussianAround, Select, SubModel
from torch_denkf.motions import AttitudeMotion, Gravity, InertialMotion, Magnetic
from torch_denkf.motions.motion import Motion
from torch_denkf.submodel import Sensor

__all__ = ["GivenNoise", "VelocityInBody", "attitude_filter", "inertial_filter", "prepared"]

Kind = Literal["EKF", "UKF", "etkf", "perturbed"]
FEATURES = ("size", "turn", "unrest")  # of a reading of the accelerometer
LEG = 0.1  # m/s: standard deviation of the base's velocity from the standing foot; set by us, and not tuned
_UNREST = 1.0  # s
_START = (0.05, 0.3, 0.1, 0.01, 0.1)  # standard deviations: rad, m/s, m, rad/s, m/s^2


class GivenNoise(Sensor):
    """Noise from an entry ``[*B, 1]``, the standard deviation, so that one batch tries several values."""

    def __init__(self, in_key: str = "std"):
        super().__init__(nn.Identity(), [in_key], [("sensor", "noise")])
        self.observation_dim = 3

    def compute(self, std):
        """Returns the variance, repeated for all three components."""
        return std.square().expand(*std.shape[:-1], 3)


class VelocityInBody(SubModel):
    """Maps states whose first part is of ``SE23()`` to velocities in the body's axes ``[*B, E, 3]``."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("forecast", "observation")])

    def compute(self, state):
        """Returns the velocity, rotated from the world's axes to the body's."""
        return rotate(SO3().inverse(state[..., :4]), state[..., 4:7])


def prepared(data: TensorDict) -> TensorDict:
    """Returns a log with the filters' further inputs: direction of the accelerometer, its features, masks, and states.

    Args:
        data: of :mod:`benchmarks.attitude.task`, ``[R, T]``.

    Returns:
        ``"up"``, the direction of the accelerometer's reading; ``"features"`` ``[R, T, 3]``: the difference of its norm
        from gravity, the same averaged over about a second, both in m/s^2, and the angular rate in rad/s; ``"rest"``,
        zeros in m/s; ``"attitude"`` and ``"inertial"``, states of the two motions, with zero biases and velocities:
        filters start from those of the first row. Magnetometer, rest and leg have a reading in every tenth row.
    """
    data = data.clone()
    force, runs, rows = data["accelerometer"], *data.shape
    size = force.norm(dim=-1, keepdim=True)
    data["up"] = force / size
    away, keep = (size - GRAVITY).abs(), 1 - DT / _UNREST
    unrest, last = [], away[:, 0]
    for row in range(rows):
        last = keep * last + (1 - keep) * away[:, row]
        unrest.append(last)
    data["features"] = torch.cat([away, data["gyro"].norm(dim=-1, keepdim=True), torch.stack(unrest, 1)], -1)
    data["rest"] = force.new_zeros(runs, rows, 3)
    tenth = (torch.arange(rows) % 10 == 0).reshape(1, rows, 1).expand(runs, rows, 1)
    data["rest_observed"] = data["magnetometer_observed"] = tenth
    if "leg" in data:
        data["leg_observed"] = data["leg_observed"] & tenth
    orientation = SO3().normalise(data["orientation"])
    data["attitude"] = torch.cat([orientation, force.new_zeros(runs, rows, 3)], -1)
    data["inertial"] = torch.cat([orientation, force.new_zeros(runs, rows, 12)], -1)
    return data


def attitude_filter(
    kind: Kind,
    gyro_noise: float,
    up_noise: float | SubModel,
    *,
    members: int = 64,
    magnetometer: bool = False,
    **options,
) -> Filter:
    """Returns a filter of orientation and gyro bias, driven by the gyro; the accelerometer's direction is the reading.

    Args:
        kind: of filter; for ensembles the scheme.
        gyro_noise: density in rad/s/sqrt(Hz).
        up_noise: standard deviation of the direction, in rad, or a module that writes its variances ``[*B, 3]``.
        members: of ensembles.
        magnetometer: read it, too, in a :class:`~torch_denkf.FusedFilter`, whose Gaussian kind is the EKF.
        **options: of the ensemble's analysis.
    """
    motion = AttitudeMotion("dt", gyro_noise=gyro_noise, gyro_walk=Sensors().gyro_walk)
    up = Gravity(motion.space, gravity=1.0)
    noise = ConstantNoise([up_noise] * 3, in_key="up") if isinstance(up_noise, float) else up_noise
    initial = _initial(kind, motion.space, _START[:1] + _START[3:4], "attitude", members)
    known = {"initial": initial, "process_noise": motion.noise_of_step(DT)}
    if magnetometer:
        sensors = {
            "up": FusedSensor(up, noise),
            "magnetometer": FusedSensor(Magnetic(motion.space, FIELD), [Sensors().magnetometer] * 3),
        }
        return _fused(kind, motion, sensors, known, options)
    if kind in ("EKF", "UKF"):
        return {"EKF": EKF, "UKF": UKF}[kind](motion, None, up, noise, observation_key="up", **known)
    analysis = EnsembleAnalysis(kind, space=motion.space, observation_key="up", **options)
    return DEnKF(motion, None, up, noise, analysis, **known)


def inertial_filter(
    kind: Kind,
    gyro_noise: float,
    rest_noise: float | SubModel,
    *,
    members: int = 64,
    magnetometer: bool = False,
    feet: bool = False,
    **options,
) -> FusedFilter:
    """Returns a filter of orientation, velocity, position and biases of a body that stays about a place.

    Args:
        kind: ``"EKF"``, or the scheme of an ensemble.
        gyro_noise: density in rad/s/sqrt(Hz).
        rest_noise: standard deviation of the pseudo-observation of zero velocity, ten times a second, in m/s, or a
            module that writes variances ``[*B, 3]``.
        members: of ensembles.
        magnetometer: read it, too.
        feet: read ``"leg"``, the body velocity by the stance foot, instead of a velocity of zero.
        **options: of the ensemble's analyses.
    """
    sheet = Sensors()
    walks = {"gyro_walk": sheet.gyro_walk, "accelerometer_walk": sheet.accelerometer_walk}
    force_noise = sheet.accelerometer_noise * max(1.0, gyro_noise / sheet.gyro_noise)  # both as far off the data sheet
    motion = InertialMotion("dt", gyro_noise=gyro_noise, accelerometer_noise=force_noise, gravity=GRAVITY, **walks)
    if feet:
        sensors = {"leg": FusedSensor(VelocityInBody(), [LEG] * 3)}
    else:
        noise = ConstantNoise([rest_noise] * 3, in_key="rest") if isinstance(rest_noise, float) else rest_noise
        sensors = {"rest": FusedSensor(Select([4, 5, 6]), noise)}
    if magnetometer:
        sensors["magnetometer"] = FusedSensor(Magnetic(motion.space, FIELD), [sheet.magnetometer] * 3)
    known = {
        "initial": _initial(kind, motion.space, _START, "inertial", members),
        "process_noise": motion.noise_of_step(DT),
    }
    return _fused(kind, motion, sensors, known, options)


def _initial(kind: Kind, space: Space, std: tuple[float, ...], key: str, members: int) -> SubModel:
    each = [one for one in std for _ in range(3)]
    if kind in ("EKF", "UKF"):
        return GaussianAround(each, state_key=key, space=space)
    return AroundState(each, ensemble_size=members, state_key=key, space=space)


def _fused(kind: Kind, motion: Motion, sensors: dict, known: dict, options: dict) -> FusedFilter:
    analysis = None if kind == "EKF" else partial(EnsembleAnalysis, kind, **options)
    return FusedFilter(motion, sensors, analysis=analysis, **known)
