"""Logs of a simulated quadruped and of a real humanoid, and how well a filter knows the base's motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf import Filter
from torch_denkf.applications.legged import QUADRUPED, quadruped_env, trot
from torch_denkf.applications.legged.icub import ICUB, icub_log, icub_model
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.applications.legged.velocity import base_velocity_of_moments
from torch_denkf.functional.manifolds import SO3, rotate

__all__ = ["LEVEL", "Robot", "humanoid", "quadruped", "scores", "smoothed_velocity"]

LEVEL = 0.9  # of the intervals


@dataclass(frozen=True)
class Robot:
    """A robot and its log.

    Attributes:
        name: of the robot.
        model: its chains of joints.
        names: of its feet, sensor and joints.
        dt: of the filter: seconds, or the key of them.
        log: ``[R, T]``, readings and truth.
        rows: that are scored.
        doubtful: rows ``[R, T]`` of which the truth is in doubt.
    """

    name: str
    model: mujoco.MjModel
    names: dict[str, Any]
    dt: float | str
    log: TensorDict
    rows: slice
    doubtful: Tensor


def quadruped(runs: int, seconds: float, seed: int) -> Robot:
    """dm_control's quadruped, which trots at paces, strides and turns of its own in each run; all sensors err.

    Args:
        runs: R.
        seconds: of a run, 100 rows each.
        seed: of gaits and errors.
    """
    random, logs = np.random.default_rng(seed), []
    env = quadruped_env(seed=seed)
    for _ in range(runs):
        low, high = [0.8, 0.2, 0.2, -0.3], [1.2, 0.4, 0.4, 0.3]
        gait = dict(zip(("pace", "stride", "height", "turn"), random.uniform(low, high).tolist(), strict=True))
        row, rows = env.reset(), []
        for step in range(round(seconds / env.dt)):
            rows.append(row.exclude("action", "done", "terminated", "reward"))
            row["action"] = min(1.0, step * env.dt) * trot(step * env.dt, **gait)
            row = env.step(row)["next"]
        logs.append(torch.stack(rows))
    log = torch.stack(logs).double().update({"contact": torch.stack([each["contact"] for each in logs])})
    log = log.select("imu", "joints", "joint_rates", "contact", "true")
    start = min(100, log.shape[1] // 2)
    doubtful = torch.zeros(log.shape, dtype=torch.bool)
    return Robot("quadruped, simulated", env.model, QUADRUPED, env.dt, log, slice(start, None), doubtful)


def humanoid(folder: Path) -> Robot:
    """The walk of iCub. Its truth is in doubt where motion capture moves a foot that carries the whole robot.

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


def base_pose(robot: Robot, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Orientation and position of the base, of beliefs about its sensor ``[R, T, 16 + 3 F]``."""
    sensor = LegKinematics(robot.model, **robot.names).base.to(mean.dtype)
    turn = SO3().compose(mean[..., :4], SO3().inverse(sensor[:4]).expand_as(mean[..., :4]))
    return turn, mean[..., 7:10] - rotate(turn, sensor[4:])


def smoothed_velocity(robot: Robot, out: TensorDictBase, gyro_std: float) -> tuple[Tensor, Tensor]:
    """The base's velocity and its variances, of what a smoother of moments or of an ensemble wrote.

    An ensemble's covariance is that of its members.
    """
    sensor = LegKinematics(robot.model, **robot.names).base.double()
    gyro, mean = robot.log["imu"][..., :3], out["smoothed", "mean"]
    cov = out.get(("smoothed", "cov"), None)
    if cov is None:
        from torch_denkf.applications.legged.motion import legged_space

        space = legged_space(len(robot.names["feet"]))
        away = space.minus(out["smoothed", "ensemble"], mean.unsqueeze(-2))
        cov = away.mT @ away / (away.shape[-2] - 1)
    velocity, var = base_velocity_of_moments(mean, cov, gyro, sensor)
    return velocity, var + gyro_std**2 * sensor[4:].square().sum()


def scores(robot: Robot, mean: Tensor, velocity: Tensor, var: Tensor) -> dict[str, float]:
    """How wrong the base's velocity, tilt and path are, and how wide the velocity's intervals.

    Args:
        robot: with its log.
        mean: ``[R, T, 16 + 3 F]``.
        velocity: of the base in its own axes, ``[R, T, 3]``.
        var: its variances.

    Returns:
        Root mean square errors of the velocity in m/s: ``x``, ``y``, ``z``, ``norm``, and ``certain``, the norm without
        rows whose truth is in doubt; ``held``, the share of the true velocities in the intervals, and
        ``held_certain``; ``nees``, the mean square error by variance, and ``nees_certain``; ``nll``, the mean negative
        log-likelihood; ``tilt`` in degrees; ``drift``, how far the end of the path is off, in % of its length.
    """
    true, rows, half = robot.log["true"], robot.rows, NormalDist().inv_cdf((1 + LEVEL) / 2)
    error, var = (velocity - true["velocity"])[:, rows], var[:, rows]
    sure = ~robot.doubtful[:, rows]
    square, inside = error.square(), (error.abs() <= half * var.sqrt()).double()
    x, y, z = square.mean((0, 1)).sqrt().tolist()
    turn, place = base_pose(robot, mean)
    up = [rotate(SO3().inverse(each), mean.new_tensor([0.0, 0.0, 1.0]))[:, rows] for each in (turn, true["orientation"])]
    tilt = torch.atan2(torch.linalg.cross(*up).norm(dim=-1), (up[0] * up[1]).sum(-1)).rad2deg()
    walked = true["position"].diff(dim=1).norm(dim=-1).sum(1) if robot.name != "iCub" else _steps(true["position"])
    moved = [_from_start(*pose) for pose in ((turn, place), (true["orientation"], true["position"]))]
    drift = (moved[0][:, -1] - moved[1][:, -1]).norm(dim=-1) / walked
    return {
        "x": x,
        "y": y,
        "z": z,
        "norm": square.sum(-1).mean().sqrt().item(),
        "certain": square.sum(-1)[sure].mean().sqrt().item(),
        "held": inside.mean().item(),
        "held_certain": inside[sure].mean().item(),
        "nees": (square / var).mean().item(),
        "nees_certain": (square / var)[sure].mean().item(),
        "nll": 0.5 * (square / var + var.log()).mean().item(),
        "tilt": tilt.square().mean().sqrt().item(),
        "drift": 100 * drift.mean().item(),
    }


def _steps(position: Tensor) -> Tensor:
    """The length of a path without the noise of single rows: of its places every 10 rows."""
    return position[:, ::10].diff(dim=1).norm(dim=-1).sum(1)


def _from_start(turn: Tensor, place: Tensor) -> Tensor:
    """Places as seen from the first one, along its heading."""
    forward = rotate(turn[:, 0], turn.new_tensor([1.0, 0.0, 0.0]))
    angle = torch.atan2(forward[:, 1], forward[:, 0])
    heading = SO3().exp(angle.unsqueeze(-1) * turn.new_tensor([0.0, 0.0, 1.0]))
    return rotate(SO3().inverse(heading).unsqueeze(1), place - place[:, :1])
