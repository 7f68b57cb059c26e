"""A filter of a legged robot's base, for any robot that MuJoCo can load."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import mujoco
import torch
from tensordict import NestedKey

from torch_denkf._checks import check_number
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.applications.legged.learned import MOVES, SLIP, LearnedContacts, Variances
from torch_denkf.applications.legged.motion import LeggedMotion, LeggedMotionNoise, LeggedSpace
from torch_denkf.applications.legged.noises import LeggedNoises
from torch_denkf.applications.legged.readings import FeetInBody, FeetRates, LegReadings
from torch_denkf.applications.legged.velocity import BaseVelocity, StartEnsemble, StartMoments
from torch_denkf.filters import Filter
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import EKFTransition, EnsembleAnalysis, NoisyTransition, UKFTransition
from torch_denkf.running import named_modules_of

__all__ = ["legged_filter"]

_FAR = 0.1  # m: initial standard deviation of a foot about its kinematics; the first reading corrects it


def legged_filter(
    model: mujoco.MjModel,
    *,
    feet: Sequence[str],
    imu: str,
    joints: Sequence[str] | None = None,
    dt: float | NestedKey,
    kind: Literal["DEnKF", "EKF", "UKF"] = "DEnKF",
    ensemble_size: int = 64,
    threshold: float | None = None,
    noises: LeggedNoises | None = None,
    contacts: LearnedContacts | None = None,
    gravity: float = 9.81,
    imu_key: NestedKey = "imu",
    joints_key: NestedKey = "joints",
    rates_key: NestedKey | None = "joint_rates",
    contact_key: NestedKey = "contact",
    **options: Any,
) -> Filter:
    r"""Returns a filter of the base of a legged robot, from an inertial sensor, joint encoders, and foot contacts.

    ``("belief", "velocity")`` ``[*B, 3]`` is the velocity of the base in its own axes, in m/s, and
    ``("belief", "velocity_var")`` its variances. ``("belief", "mean")`` ``[*B, 16 + 3 F]`` holds the sensor's
    orientation, velocity and position in the world, its biases, and the feet, see
    :class:`~torch_denkf.applications.legged.motion.LeggedSpace`. The world's origin is where the base starts, its
    heading is zero there. The robot must stand still at the start.

    The inertial sensor drives the motion, see :class:`~torch_denkf.applications.legged.motion.LeggedMotion`: its
    reading at a step is the mean over the time since the last step. Feet in contact are observed: their positions by
    the joint angles and, with ``rates_key``, their velocities by the joint rates.

    Args:
        model: of the robot, from MJCF or URDF.
        feet: names of sites or bodies, F.
        imu: name of the site or body at which the sensor sits.
        joints: names of the joints in the order of the readings; ``None`` for all hinges and slides of the model.
        dt: time step in seconds, or the key of an entry ``[*B, 1]``.
        kind: the belief: an ensemble, or a mean and a covariance.
        ensemble_size: E. With F feet, exact draws need 36 + 6 F members; far fewer need a ``threshold``.
        threshold: for localisation by significance, see :class:`~torch_denkf.modules.EnsembleAnalysis`; ``None`` for
            no localisation.
        noises: noise of the sensors and of the feet.
        contacts: learned model of the slip of each foot in contact, instead of ``slip`` and ``rate`` of ``noises``; it
            needs ``rates_key``. An ensemble uses its variances, without correlations of a foot's axes.
        gravity: in m/s^2.
        imu_key: ``[*B, 6]``: gyro in rad/s, then accelerometer in m/s^2, in the sensor's axes.
        joints_key: angles ``[*B, J]`` in rad.
        rates_key: joint rates ``[*B, J]`` in rad/s; ``None`` for no such sensor.
        contact_key: contact of each foot, ``[*B, F]`` bool.
        **options: of :class:`~torch_denkf.filters.Filter`.

    Raises:
        KeyError: if the model lacks a name.
        TypeError: on noises or contacts of another class.
        ValueError: on an unknown ``kind``, or ``contacts`` without ``rates_key``.

    Source:
        Bloesch et al. 2012, RSS VIII (feet in the state); Hartley et al. 2020, IJRR 39 (errors in the world's axes:
        ``kind="EKF"`` is their right-invariant filter, with the feet's rates as further readings).
    """
    if kind not in ("DEnKF", "EKF", "UKF"):
        raise ValueError(f'kind is "DEnKF", "EKF" or "UKF"; got {kind!r}.')
    for name, value, wanted in (("noises", noises, LeggedNoises), ("contacts", contacts, LearnedContacts)):
        if value is not None and not isinstance(value, wanted):
            raise TypeError(f"{name} is of {wanted.__name__}, or None; got {value!r}"[:200])
    if threshold is not None:
        check_number("threshold", threshold, above=0)
    if contacts is not None and rates_key is None:
        raise ValueError("LearnedContacts is about the rates of the joints: give rates_key.")
    if isinstance(dt, (int, float)):
        check_number("dt", dt, above=0, cure="It is the time step in seconds, or the key of one")
    n, kinematics = LeggedNoises() if noises is None else noises, LegKinematics(model, feet, imu, joints=joints)
    count, space = len(kinematics.feet), LeggedSpace(len(kinematics.feet))
    readings = LegReadings(
        kinematics, dt, imu_key=imu_key, joints_key=joints_key, rates_key=rates_key, contact_key=contact_key
    )
    slip_key, moves_key = (None, None) if contacts is None else (SLIP, MOVES)
    motion = LeggedMotion(count, dt, gravity=gravity, imu_key=imu_key, contact_key=contact_key, moves_key=moves_key)
    process = LeggedMotionNoise(count, dt, n, ensemble=kind == "DEnKF", contact_key=contact_key, slip_key=slip_key)
    tangent = [n.tilt] * 3 + [n.velocity] * 3 + [0.0] * 3 + [n.gyro_bias] * 3 + [n.accelerometer_bias] * 3
    around: dict[str, Any] = {"state_key": ("legs", "start"), "space": space}
    std = torch.tensor([*tangent, *[_FAR] * 3 * count])
    per_reading = n.gyro / dt**0.5 if isinstance(dt, (int, float)) else n.gyro * 10.0
    velocity = BaseVelocity(kinematics.base, per_reading, ensemble=kind == "DEnKF", imu_key=imu_key)
    analysis = None
    if kind == "DEnKF":
        initial = StartEnsemble(std, n.velocity, velocity, ensemble_size=ensemble_size, **around)
        more: dict[str, Any] = {} if threshold is None else {"localisation": "significance", "threshold": threshold}
        analysis = partial(EnsembleAnalysis, "etkf", **more)
        transition = NoisyTransition(motion, process, space=process.space)
    else:
        initial = StartMoments(std, n.velocity, velocity, **around)
        transition = {"EKF": EKFTransition, "UKF": UKFTransition}[kind](motion, process, space=space)
    mask: dict[str, Any] = {"observed_key": ("legs", "observed")}
    sensors = {
        "feet": FusedSensor(FeetInBody(space), [n.kinematics] * 3 * count, observation_key=("legs", "feet"), **mask)
    }
    if rates_key is not None:
        noise: Any = [n.rate] * 3 * count if contacts is None else contacts
        if kind == "DEnKF" and contacts is not None:
            noise = Variances(contacts)
        rates = FeetRates(space, imu_key=imu_key, moves_key=moves_key)
        sensors["rates"] = FusedSensor(rates, noise, observation_key=("legs", "rates"), **mask)
    fused = FusedFilter(transition, sensors, initial=initial, analysis=analysis)
    modules = OrderedDict(legs=readings, **dict(named_modules_of(fused)), velocity=velocity)
    return Filter(modules, initial=initial, **options)
