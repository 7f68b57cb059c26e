"""Noise of a legged robot's sensors, and of the velocity of a stance foot."""

from __future__ import annotations

from dataclasses import dataclass, fields

from torch_denkf._checks import check_number

__all__ = ["LeggedNoises"]


@dataclass(frozen=True)
class LeggedNoises:
    """Noise model of a filter of a legged robot's base.

    The defaults fit :func:`~torch_denkf.applications.legged.quadruped_env` on firm ground, with a margin for a worse
    accelerometer. Sliding feet or irregular time stamps need more.

    Attributes:
        gyro: density of the gyro's white noise, in rad/s/sqrt(Hz).
        accelerometer: that of the accelerometer, in m/s^2/sqrt(Hz), with vibration between two readings.
        gyro_walk: random walk of the gyro's bias, in rad/s^2/sqrt(Hz).
        accelerometer_walk: that of the accelerometer's bias, in m/s^3/sqrt(Hz).
        slip: random walk of a stance foot, in m/sqrt(s).
        kinematics: error of a foot's position by the joints, in m.
        rate: error of a stance foot's velocity by the joint rates, in m/s.
        tilt: initial error of the inclination, in rad; the initial heading is zero by definition.
        velocity: initial error of the base's velocity, in m/s.
        gyro_bias: initial error of the gyro's bias, in rad/s.
        accelerometer_bias: initial error of the accelerometer's bias, in m/s^2.

    Raises:
        ValueError: if a number is negative.
    """

    gyro: float = 1e-3
    accelerometer: float = 2e-2
    gyro_walk: float = 1e-4
    accelerometer_walk: float = 1e-3
    slip: float = 1e-2
    kinematics: float = 1e-2
    rate: float = 0.3
    tilt: float = 0.03
    velocity: float = 0.05
    gyro_bias: float = 0.01
    accelerometer_bias: float = 0.1

    def __post_init__(self):
        for each in fields(self):
            check_number(each.name, getattr(self, each.name), least=0)
