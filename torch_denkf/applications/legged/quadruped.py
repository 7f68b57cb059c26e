"""dm_control's quadruped, its trot, and its filter with learned contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal
from xml.etree import ElementTree

import torch

from torch_denkf._checks import check_number
from torch_denkf.applications.legged.environment import LeggedEnv, LeggedErrors, on_floor
from torch_denkf.applications.legged.filter import legged_filter
from torch_denkf.applications.legged.learned import LearnedContacts
from torch_denkf.applications.legged.noises import LeggedNoises
from torch_denkf.filters import Filter

__all__ = ["QUADRUPED", "quadruped", "quadruped_env", "trot"]

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
    """Returns dm_control's quadruped on a floor, with an inertial sensor next to its middle, 100 steps per second.

    Args:
        errors: of the sensors.
        friction: friction coefficient of feet and floor. With 0.3, feet slide.
        softness: time constant of the contact, in s.
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
    """Returns controls ``[12]`` of dm_control's quadruped for a trot: diagonal legs swing in turn.

    Args:
        time: in s.
        pace: strides per second.
        stride: amplitude of the hips.
        height: lift of the legs.
        turn: relative difference of right and left strides, -1 to 1.
    """
    for name, value in {"time": time, "pace": pace, "stride": stride, "height": height, "turn": turn}.items():
        check_number(name, value)
    found = []
    for number, side in enumerate((-1.0, 1.0, 1.0, -1.0)):  # front left, front right, back right, back left
        phase = 2 * math.pi * pace * time + math.pi * (number % 2)
        ahead = stride * (1 + side * turn) * math.cos(phase)
        found += [side * ahead, -height * max(0.0, -math.sin(phase)), 0.0]
    return torch.tensor(found)


def quadruped(
    *,
    rows: int = 10,
    num_cells: Sequence[int] = (48, 48),
    dt: float = 0.01,
    kind: Literal["DEnKF", "EKF", "UKF"] = "EKF",
    **noises: float,
) -> Filter:
    """Returns an untrained filter of dm_control's quadruped, with :class:`LearnedContacts`.

    ``from_pretrained("quadruped")`` is this filter, trained. It reads the rows of ``last_rows(10, every=5)``.

    Args:
        rows: K, number of input rows of the contacts.
        num_cells: hidden layers of their networks.
        dt: time step in seconds.
        kind: the belief.
        **noises: of :class:`~torch_denkf.applications.legged.LeggedNoises`.
    """
    model, known = quadruped_env().model, LeggedNoises(**noises)
    contacts = LearnedContacts(model, **QUADRUPED, rows=rows, rate=known.rate, num_cells=num_cells)
    return legged_filter(model, **QUADRUPED, dt=dt, kind=kind, noises=known, contacts=contacts)
