"""dm_control's humanoid in a moving harness, and its gait."""

from __future__ import annotations

import math
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch

from torch_denkf._checks import check_number
from torch_denkf.applications.legged.environment import LeggedEnv, LeggedErrors, on_floor

__all__ = ["HUMANOID", "HarnessedEnv", "humanoid_env", "stroll"]

#: Names of dm_control's humanoid, as :class:`LeggedEnv` and :func:`legged_filter` take them.
HUMANOID: dict[str, Any] = {"feet": ["left_foot", "right_foot"], "imu": "root"}
_HEIGHT = 1.24  # m: below it the harness carries


class HarnessedEnv(LeggedEnv):
    """A robot with its base in a moving harness that prevents falls, as in a laboratory.

    Springs and dampers of the harness align the base upright and with the heading, pull it along, and carry it if it
    sinks. Otherwise the legs carry the robot.

    Args:
        speed: speed of the harness, in m/s, reached within a second.
        turn: yaw rate of the harness, in rad/s.
        *args: of :class:`LeggedEnv`.
        **options: of :class:`LeggedEnv`.
    """

    def __init__(self, *args, speed: float = 0.5, turn: float = 0.0, **options):
        check_number("speed", speed)
        check_number("turn", turn)
        self.speed, self.turn = speed, turn
        super().__init__(*args, **options)

    def _reset(self, *args, **kwargs):
        self.place, self.heading, self.begun = np.zeros(2), 0.0, math.inf  # the harness rests until the episode begins
        readings = super()._reset(*args, **kwargs)
        self.begun = self.data.time
        return readings

    def _simulate(self) -> None:
        force = self.data.xfrc_applied[self.base]
        others = force.copy()
        force += self._harness()
        super()._simulate()
        force[:] = others

    def _harness(self) -> np.ndarray:
        """Returns the harness's force on the base in N, and its torque in Nm, in the world's axes."""
        data, step = self.data, self.model.opt.timestep
        share = min(1.0, max(0.0, data.time - self.begun))
        self.heading += share * self.turn * step
        ahead = np.array([math.cos(self.heading), math.sin(self.heading)])
        self.place = self.place + share * self.speed * step * ahead
        axes = data.xmat[self.base].reshape(3, 3)
        wanted = np.array([[ahead[0], -ahead[1], 0.0], [ahead[1], ahead[0], 0.0], [0.0, 0.0, 1.0]])
        off = 0.5 * np.cross(axes.T, wanted.T).sum(0)
        level = 400 * (self.place - data.qpos[:2]) - 80 * (data.qvel[:2] - share * self.speed * ahead)
        upwards = max(0.0, 1500 * (_HEIGHT - data.qpos[2])) - 100 * data.qvel[2]
        return np.array([*level, upwards, *(600 * off - 40 * axes @ data.qvel[3:6])])


def humanoid_env(
    errors: LeggedErrors | None = None,
    *,
    friction: float = 1.5,
    softness: float = 0.01,
    pushes: float = 0.0,
    speed: float = 0.5,
    turn: float = 0.0,
    seed: int = 0,
) -> HarnessedEnv:
    """Returns dm_control's humanoid in a harness, with an inertial sensor next to its chest, 100 steps per second.

    Its motors turn joints to the angles of the action, in rad.

    Args:
        errors: of the sensors.
        friction: friction coefficient of feet and floor. With 0.3, feet slide.
        softness: time constant of the contact, in s.
        pushes: standard deviation in N, see :class:`LeggedEnv`. The robot has 41 kg.
        speed: speed of the harness, in m/s.
        turn: yaw rate of the harness, in rad/s.
        seed: of errors and pushes.

    Raises:
        ValueError: if ``friction`` or ``softness`` is not above zero.
    """
    from dm_control.suite import humanoid  # type: ignore[import-untyped]  # which takes seconds

    xml, assets = humanoid.get_model_and_assets()
    robot = ElementTree.fromstring(xml)
    site = next(site for site in robot.iter("site") if site.get("name") == HUMANOID["imu"])
    site.attrib.update(pos="0.06 0.03 -0.05", euler="20 -30 40")
    motors = next(robot.iter("actuator"))
    for motor in list(motors):
        strength = float(motor.attrib.pop("gear")) * (3 if "ankle" in motor.attrib["name"] else 1)  # feet stay flat
        motor.tag = "position"
        motor.attrib.update(kp=f"{8 * strength}", kv=f"{0.15 * strength}", ctrlrange="-2 2")
        motor.attrib.update(forcerange=f"{-4 * strength} {4 * strength}")
    model = on_floor(robot, assets, friction, softness)
    model.body("torso").pos[2] = model.qpos0[2] = 1.285  # its feet touch the floor
    model.dof_armature[6:] = 0.08  # of its motors, in kg m^2: lighter ones shake
    return HarnessedEnv(
        model, **HUMANOID, errors=errors, on=60.0, off=40.0, pushes=pushes, speed=speed, turn=turn, seed=seed
    )


def stroll(time: float, *, pace: float = 1.0, stride: float = 0.2, lift: float = 0.4) -> torch.Tensor:
    """Returns controls ``[21]`` of dm_control's humanoid for a walk on bent legs in the harness.

    Args:
        time: in s.
        pace: strides per second.
        stride: amplitude of the hips, in rad, for a speed of about ``2.5 * stride * pace`` in m/s.
        lift: additional flexion of the knee in swing, in rad.
    """
    for name, value in {"time": time, "pace": pace, "stride": stride, "lift": lift}.items():
        check_number(name, value)
    legs, bent = [], 0.25
    for begin in (math.pi, 0.0):  # right, left
        phase = 2 * math.pi * pace * time + begin
        swing = lift * max(0.0, -math.sin(phase))
        hip, knee = -stride * math.cos(phase) - bent - 0.5 * swing, -2 * bent - swing
        legs += [0.0, 0.0, hip, knee, 0.0, knee - hip]  # the foot stays level
    return torch.tensor([0.0, 0.0, 0.0, *legs, *[0.0] * 6])
