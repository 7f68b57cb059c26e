"""dm_control's quadruped, and how it trots."""

from __future__ import annotations

import math
from typing import Any
from xml.etree import ElementTree

import torch

from torch_denkf.applications.legged.environment import LeggedEnv, LeggedErrors, on_floor

__all__ = ["QUADRUPED", "quadruped_env", "trot"]

#: Names of dm_control's quadruped, as :class:`LeggedEnv` and :func:`legged_filter` take them.
QUADRUPED: dict[str, Any] = {
    "feet": [f"toe_{side}" for side in ("front_left", "front_right", "back_right", "back_left")],
    "imu": "torso",
}


def quadruped_env(
    errors: LeggedErrors | None = None,
    *,
    friction: float = 1.5,
    softness: float = 0.01,
    pushes: float = 0.0,
    seed: int = 0,
) -> LeggedEnv:
    """dm_control's quadruped on a floor, with an inertial sensor beside its middle, 100 steps a second.

    Args:
        errors: of the sensors.
        friction: of feet and floor: the force along the floor by the force upon it. On 0.3 feet slide.
        softness: seconds in which the floor gives way and comes back.
        pushes: standard deviation in N, see :class:`LeggedEnv`. The robot has 107 kg.
        seed: of errors and pushes.
    """
    from dm_control.suite import common, quadruped  # type: ignore[import-untyped]  # which takes seconds

    robot = ElementTree.fromstring(quadruped.make_model(floor_size=200))
    site = next(site for site in robot.iter("site") if site.get("name") == QUADRUPED["imu"])
    site.attrib.update(pos="0.12 0.05 0.08", euler="30 -20 60")
    model = on_floor(robot, common.ASSETS, friction, softness)
    return LeggedEnv(model, **QUADRUPED, errors=errors, on=150.0, off=100.0, pushes=pushes, seed=seed)


def trot(
    time: float, *, pace: float = 1.0, stride: float = 0.3, height: float = 0.3, turn: float = 0.0
) -> torch.Tensor:
    """Controls ``[12]`` of dm_control's quadruped that let it trot: two legs swing while the other two stand.

    Args:
        time: in s.
        pace: strides a second.
        stride: amplitude of the hips.
        height: by how much legs are lifted.
        turn: by how much the strides of right and left legs differ, -1 to 1.
    """
    found = []
    for number, side in enumerate((-1.0, 1.0, 1.0, -1.0)):  # front left, front right, back right, back left
        phase = 2 * math.pi * pace * time + math.pi * (number % 2)
        ahead = stride * (1 + side * turn) * math.cos(phase)
        found += [side * ahead, -height * max(0.0, -math.sin(phase)), 0.0]
    return torch.tensor(found)
