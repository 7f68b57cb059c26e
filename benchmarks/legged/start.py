"""Measures the convergence of filters whose initial belief is tilted.

    python -m benchmarks.legged.start --out benchmarks/legged/results

The error dynamics of an invariant filter do not depend on its mean, so it should gain most from a large initial error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import markdown, write_page
from benchmarks.legged.study import KINDS
from benchmarks.legged.task import FIRM, Robot, base_pose, simulated
from benchmarks.legged.walk import up_of
from torch_denkf.applications.legged import LeggedNoises, legged_filter
from torch_denkf.functional.manifolds import SO3, rotate

KEPT = [("belief", "mean"), ("belief", "velocity")]


@dataclass(frozen=True)
class Start:
    """Measures the convergence of the tilt from a wrong initial belief."""

    out: Path | None = None  # folder for start.md
    runs: int = 8
    seconds: float = 4.0
    degrees: tuple[float, ...] = (0.0, 10.0, 20.0, 30.0)  # by which the start is tilted
    seed: int = 20
    smoke: bool = False  # one short run


def turned(state: Tensor, turn: Tensor) -> Tensor:
    """Rotates states ``[*, 16 + 3 F]`` about the world's origin by quaternions ``[*, 4]``."""
    turn = turn.expand(*state.shape[:-1], 4)
    feet = rotate(turn.unsqueeze(-2), state[..., 16:].unflatten(-1, (-1, 3))).flatten(-2)
    moved = [rotate(turn, state[..., 4:7]), rotate(turn, state[..., 7:10]), state[..., 10:16], feet]
    return torch.cat([SO3().compose(turn, state[..., :4]), *moved], -1)


@torch.no_grad()
def tilts(robot: Robot, kind: str, degrees: float) -> tuple[Tensor, Tensor]:
    """Returns errors of tilt in degrees and velocity in m/s, ``[R, T]``, of a filter with matching initial noise."""
    noises = LeggedNoises(tilt=max(math.radians(degrees), LeggedNoises().tilt))
    filter = legged_filter(robot.model, **robot.names, dt=robot.dt, noises=noises, **KINDS[kind])
    torch.manual_seed(0)
    first, log = filter.initialise(robot.log[:, 0].clone()), robot.log[:, 1:].clone()
    way = torch.linspace(0, 2 * math.pi, log.shape[0] + 1)[:-1]  # another horizontal axis in each run
    turn = SO3().exp(math.radians(degrees) * torch.stack([way.cos(), way.sin(), torch.zeros_like(way)], -1))
    for key in filter.carry_keys:
        value = first[key]
        if key[-1] == "mean":
            value = turned(value, turn)
        elif key[-1] == "ensemble":
            value = turned(value, turn.unsqueeze(-2))
        log["previous", *key] = value.unsqueeze(1).expand(-1, log.shape[1], *value.shape[1:]).clone()
    belief = filter.sequence(log, keep=KEPT)["belief"]
    up = [up_of(each) for each in (base_pose(robot, belief["mean"])[0], log["true", "orientation"])]
    tilt = torch.atan2(torch.linalg.cross(*up).norm(dim=-1), (up[0] * up[1]).sum(-1)).rad2deg()
    return tilt, (belief["velocity"] - log["true", "velocity"]).norm(dim=-1)


def main() -> None:
    """Measures, and writes the table."""
    study = parse(Start)
    if study.smoke:
        study = Start(runs=1, seconds=0.2, degrees=(20.0,), smoke=True)
    robot = simulated("quadruped", study.runs, study.seconds, study.seed, FIRM)
    moments, found = (10, 50, 100, 200), {}
    for kind in list(KINDS)[: 1 if study.smoke else 2]:
        for degrees in study.degrees:
            tilt, velocity = (each.square() for each in tilts(robot, kind, degrees))
            numbers = [tilt[:, min(each, tilt.shape[1]) - 1].mean().sqrt().item() for each in moments]
            numbers = [f"{each:.2f}" for each in (*numbers, tilt[:, -100:].mean().sqrt())]
            found[kind, f"{degrees:g}"] = [*numbers, f"{velocity[:, -100:].mean().sqrt():.3f}"]
            print(kind, degrees, found[kind, f"{degrees:g}"], flush=True)
    times = [f"tilt after {each / 100:g} s, deg" for each in moments]
    columns = [*times, "tilt, last second, deg", "velocity, last second, m/s"]
    table = pd.DataFrame.from_dict(found, orient="index", columns=columns)
    table.index = pd.MultiIndex.from_tuples(found, names=["filter", "start, deg"])
    text = [
        "# A start that is tilted",
        "",
        f"{study.runs} simulated runs on firm ground. Each begins with a belief that is tilted about another axis, and "
        "that knows by how much it may be. Errors are root mean squares over the runs; the last columns are those of "
        "the last second.",
        "",
        *markdown(table),
        "",
        *made_by("legged.start"),
    ]
    write_page("\n".join(text) + "\n", None if study.out is None else study.out / "start.md")


if __name__ == "__main__":
    main()
