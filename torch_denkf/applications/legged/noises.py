"""Noise of a legged robot's sensors, and of the velocity of a standing foot."""

from __future__ import annotations

from dataclasses import dataclass, fields

from torch_denkf._checks import check_number

__all__ = ["LeggedNoises"]


@dataclass(frozen=True)
class LeggedNoises:
    """Noise model of a filter of a legged robot's base.

    The defaults fit :func:`~torch_denkf.applications.legged.quadruped_env` on firm ground, with some room for a worse
    accelerometer. Feet that slide, or rows that are stamped unevenly, ask for more.

    Attributes:
        gyro: density of its white noise, in rad/s/sqrt(Hz).
        accelerometer: in m/s^2/sqrt(Hz); vibration between two readings is in it.
        gyro_walk: of the random walk of its bias, in rad/s^2/sqrt(Hz).
        accelerometer_walk: in m/s^3/sqrt(Hz).
        slip: how a standing foot walks at random, in m/sqrt(s).
        kinematics: of a foot's position by the joints, in m.
        rate: of the velocity of a standing foot by the joints' rates, in m/s.
        tilt: of the orientation at the start, in rad; the heading starts from zero, and is what it is called.
        velocity: of the base at the start, in m/s.
        gyro_bias: at the start, in rad/s.
        accelerometer_bias: at the start, in m/s^2.

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
