"""Logs of a simulated quadruped, a simulated humanoid and a real one, and scores of a filter on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.applications.legged import QUADRUPED, quadruped_env, trot, with_last_rows
from torch_denkf.applications.legged.environment import LeggedEnv
from torch_denkf.applications.legged.humanoid import HUMANOID, humanoid_env, stroll
from torch_denkf.applications.legged.icub import ICUB, icub_log, icub_model
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.functional.manifolds import SO3, rotate

__all__ = [
    "FIRM",
    "GROUNDS",
    "LEVEL",
    "ROWS",
    "SIMULATED",
    "Ground",
    "Robot",
    "icub",
    "jittered",
    "simulated",
    "scores",
]

LEVEL = 0.9  # of the intervals
ROWS, EVERY = 10, 5  # the learned contacts read ten rows, every fifth


@dataclass(frozen=True)
class Ground:
    """Ranges of the floor's properties and of forces on the robot, from which each run draws.

    Attributes:
        friction: drawn uniformly in its logarithm.
        softness: seconds in which the floor gives way.
        pushes: standard deviation in N of forces on the base.
    """

    friction: tuple[float, float] = (0.15, 1.5)
    softness: tuple[float, float] = (0.01, 0.06)
    pushes: tuple[float, float] = (0.0, 250.0)


FIRM = Ground((1.5, 1.5), (0.01, 0.01), (0.0, 0.0))
#: Grounds of the test, by name.
GROUNDS = {
    "firm ground": FIRM,
    "slippery ground, friction 0.2": Ground((0.2, 0.2), (0.01, 0.01), (0.0, 0.0)),
    "ice, friction 0.1: not seen in training": Ground((0.1, 0.1), (0.01, 0.01), (0.0, 0.0)),
    "soft ground with pushes": Ground((0.5, 1.0), (0.05, 0.05), (200.0, 200.0)),
}


@dataclass(frozen=True)
class Robot:
    """A robot and its log.

    Attributes:
        name: of the robot.
        model: its chains of joints.
        names: of its feet, sensor and joints.
        dt: of the filter: seconds, or the key of them.
        log: ``[R, T]``, readings and truth.
        rows: to score.
        doubtful: mask ``[R, T]`` of rows with an uncertain truth.
    """

    name: str
    model: mujoco.MjModel
    names: dict[str, Any]
    dt: float | str
    log: TensorDict
    rows: slice
    doubtful: Tensor


def _trots(random: np.random.Generator, options: dict[str, float]) -> tuple[LeggedEnv, Callable[[float], Tensor]]:
    """Returns a quadruped, and its controls as a function of time."""
    low, high = [0.8, 0.2, 0.2, -0.3], [1.2, 0.4, 0.4, 0.3]
    gait = dict(zip(("pace", "stride", "height", "turn"), random.uniform(low, high).tolist(), strict=True))
    return quadruped_env(**options), lambda time: min(1.0, time) * trot(time, **gait)


def _strolls(random: np.random.Generator, options: dict[str, float]) -> tuple[LeggedEnv, Callable[[float], Tensor]]:
    """Returns a humanoid in its harness, and its controls as a function of time."""
    pace, stride, lift, turn, fits = random.uniform([0.8, 0.12, 0.3, -0.2, 0.9], [1.1, 0.22, 0.5, 0.2, 1.1]).tolist()
    options["pushes"] *= 0.4  # in proportion to its weight
    env = humanoid_env(**options, speed=2.5 * fits * stride * pace, turn=turn)
    return env, lambda time: stroll(time, pace=pace, stride=min(1.0, time) * stride, lift=min(1.0, time) * lift)


#: Simulated robots: names of their parts, and the function that makes one with its gait.
SIMULATED: dict[str, tuple[dict[str, Any], Callable]] = {
    "quadruped": (QUADRUPED, _trots),
    "humanoid": (HUMANOID, _strolls),
}


def simulated(kind: str, runs: int, seconds: float, seed: int, ground: Ground | None = None) -> Robot:
    """Returns a walking robot of dm_control, with other strides and turns in each run and noise on all sensors.

    Args:
        kind: one of ``SIMULATED``.
        runs: R.
        seconds: of a run, 100 rows each.
        seed: of grounds, gaits and errors.
        ground: of the walk; ``None`` for that of training.
    """
    random, logs, ground = np.random.default_rng(seed), [], Ground() if ground is None else ground
    names, walks = SIMULATED[kind]
    for run in range(runs):
        options = {name: random.uniform(*getattr(ground, name)) for name in ("softness", "pushes")}
        options["friction"] = math.exp(random.uniform(*(math.log(each) for each in ground.friction)))
        env, controls = walks(random, options | {"seed": 1000 * seed + run})
        row, rows = env.reset(), []
        for step in range(round(seconds / env.dt)):
            rows.append(row.select("imu", "joints", "joint_rates", "contact", "true"))
            row["action"] = controls(step * env.dt)
            row = env.step(row)["next"]
        logs.append(torch.stack(rows))
    log = with_last_rows(torch.stack(logs), ROWS, EVERY)
    doubtful = torch.zeros(log.shape, dtype=torch.bool)
    return Robot(kind, env.model, names, env.dt, log, slice(min(100, log.shape[1] // 2), None), doubtful)


def icub(folder: Path) -> Robot:
    """Returns the walk of iCub; its truth is doubtful where motion capture moves the stance foot.

    Args:
        folder: with ``model.urdf`` and ``walking.npz``.
    """
    log = icub_log(folder)
    feet, time = log["true", "feet"], log["dt"].cumsum(1)
    speed = (feet[:, 10:] - feet[:, :-10]).norm(dim=-1) / (time[:, 10:] - time[:, :-10])
    speed = torch.cat([speed[:, :1].expand(-1, 5, -1), speed, speed[:, -1:].expand(-1, 5, -1)], 1)
    slides = ((log["force"] > 0.85 * log["force"].sum(-1).median()) & (speed > 0.15)).any(-1).double()
    doubtful = torch.nn.functional.max_pool1d(slides, 21, 1, 10) > 0  # the derivative spans as many rows
    return Robot("iCub", icub_model(folder), ICUB, "dt", log, slice(50, 1168), doubtful)


def jittered(robot: Robot, like: Robot) -> Robot:
    """Returns a robot whose time stamps ``"dt"`` are as uneven as those of another."""
    dt = like.log["dt"][:, 1:, 0]
    late = dt.std() / 2**0.5 * torch.randn(*robot.log.shape, 1).to(dt)
    steps = robot.dt + torch.cat([torch.zeros_like(late[:, :1]), late.diff(dim=1)], 1)
    log = robot.log.clone().set("dt", steps.clamp(min=1e-4).to(robot.log["imu"].dtype))
    return replace(robot, log=log, dt="dt")


def base_pose(robot: Robot, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Returns orientation and position of the base from beliefs about its sensor ``[R, T, 16 + 3 F]``."""
    sensor = LegKinematics(robot.model, **robot.names).base.to(mean.dtype)
    turn = SO3().compose(mean[..., :4], SO3().inverse(sensor[:4]).expand_as(mean[..., :4]))
    return turn, mean[..., 7:10] - rotate(turn, sensor[4:])


def scores(robot: Robot, velocity: Tensor, var: Tensor, mean: Tensor | None = None) -> dict[str, float]:
    """Returns errors of the base's velocity, tilt and path, and the calibration of the velocity.

    Args:
        robot: with its log.
        velocity: of the base in its own axes, ``[R, T, 3]``.
        var: its variances.
        mean: of a filter ``[R, T, 16 + 3 F]``; ``None`` if only the velocity is known.

    Returns:
        ``velocity``, the root mean square error of the velocity in m/s, and ``certain``, the same without rows with an
        uncertain truth; ``held``, the coverage of the intervals; ``nees``, the mean of square
        error by variance; ``nll``, the mean negative log-likelihood. With ``mean`` also ``tilt`` in degrees, and
        ``drift``, the error at the end of the path in % of its length.
    """
    true, rows, half = robot.log["true"], robot.rows, NormalDist().inv_cdf((1 + LEVEL) / 2)
    error, var = (velocity - true["velocity"])[:, rows], var[:, rows]
    sure = ~robot.doubtful[:, rows]
    square = error.square()
    found = {
        "velocity": square.sum(-1).mean().sqrt().item(),
        "certain": square.sum(-1)[sure].mean().sqrt().item(),
        "nees": (square / var).mean().item(),
        "held": (error.abs() <= half * var.sqrt()).double().mean().item(),
        "nll": 0.5 * (square / var + var.log()).mean().item(),
    }
    if mean is None:
        return found
    turn, place = base_pose(robot, mean)
    up = [
        rotate(SO3().inverse(each), mean.new_tensor([0.0, 0.0, 1.0]))[:, rows] for each in (turn, true["orientation"])
    ]
    tilt = torch.atan2(torch.linalg.cross(*up).norm(dim=-1), (up[0] * up[1]).sum(-1)).rad2deg()
    moved = [_from_start(*pose) for pose in ((turn, place), (true["orientation"], true["position"]))]
    drift = (moved[0][:, -1] - moved[1][:, -1]).norm(dim=-1) / _length(true["position"])
    return {**found, "tilt": tilt.square().mean().sqrt().item(), "drift": 100 * drift.mean().item()}


def _length(position: Tensor) -> Tensor:
    """Returns the length of a path, from every tenth row to average out noise."""
    return position[:, ::10].diff(dim=1).norm(dim=-1).sum(1)


def _from_start(turn: Tensor, place: Tensor) -> Tensor:
    """Returns places relative to the first one, in the axes of its heading."""
    forward = rotate(turn[:, 0], turn.new_tensor([1.0, 0.0, 0.0]))
    angle = torch.atan2(forward[:, 1], forward[:, 0])
    heading = SO3().exp(angle.unsqueeze(-1) * turn.new_tensor([0.0, 0.0, 1.0]))
    return rotate(SO3().inverse(heading).unsqueeze(1), place - place[:, :1])
