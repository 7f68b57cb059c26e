"""The path of a car: the filter's own smoothing of its history against a path of the smoothers' velocities."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor

from benchmarks.common.tables import Columns
from benchmarks.smoothing.recordings import Task
from torch_denkf.applications.car import UnicycleMotion
from torch_denkf.applications.car.odometry.evaluation import path_errors
from torch_denkf.applications.car.odometry.filter import CarFilter
from torch_denkf.applications.car.unicycle import unicycle_move
from torch_denkf.filters import Filter
from torch_denkf.modules import EnsembleAnalysis
from torch_denkf.smoothers import EnKS

WINDOW = 100  # steps
COLUMNS = Columns(
    names=("group", "drive", "method", "translation_m_per_m"),
    text=("group", "drive", "method"),
    whole=(),
    order=lambda row: tuple(str(row[key]) for key in COLUMNS.names[:3]),
)


def without_smoothing(car: CarFilter) -> Filter:
    """The car's filter behind its sensor, whose path is that of the filtered velocities."""
    behind = car.without_sensor()
    parts = {name: behind[name] for name in behind.module}
    analysis = next(module for module in car.modules() if isinstance(module, EnsembleAnalysis))
    motion = UnicycleMotion(car.settings.dt, history_key=("belief", "history"))
    return Filter({**parts, "analysis": TensorDictSequential(analysis, motion)}, initial=behind.initial)


def walk(ensemble: Tensor, dt: float) -> Tensor:
    """The path ``[N, T, 3]`` of members ``[N, T, E, 5]`` that begin at their pose and go on with their velocities."""
    poses = [ensemble[:, 0, :, :3]]
    for velocity in ensemble[:, 1:, :, 3:].unbind(1):
        poses.append(unicycle_move(poses[-1], velocity, dt))
    return torch.stack(poses, 1).mean(-2)


@torch.no_grad()
def paths(make: Callable[[], Task], readings: Path) -> list[dict]:
    """End point errors by drive and method."""
    task, rows = make(), []
    car = task.model(task.members[0])
    assert isinstance(car, CarFilter)
    own, plain, lags = task.behind(car), without_smoothing(car), car.settings.lags
    for group, batches in task.groups(task.members[0], readings).items():
        for names, batch in batches.items():
            truth, found = batch["state"][..., :3].double(), {}
            torch.manual_seed(0)
            found[f"history of {lags}"] = own.sequence(batch.copy())["belief", "mean"][..., :3]
            for lag in (0, lags):
                torch.manual_seed(0)
                out = EnKS(plain, lag).sequence(batch.copy(), keep=[])
                path = walk(out["smoothed", "ensemble"], car.settings.dt)
                found[f"EnKS, lag {lag}" if lag else "filtered velocities"] = path
            for method, path in found.items():
                for n, name in enumerate(names.split()):
                    error = path_errors(path[n].double(), truth[n], min(WINDOW, truth.shape[1] - 1))
                    row = {"group": group, "drive": name, "method": method}
                    rows.append({**row, "translation_m_per_m": error["translation_m_per_m"]})
    return rows
