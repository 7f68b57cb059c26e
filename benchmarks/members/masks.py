"""Dropout masks that are balanced over the members against independent ones: ``python -m benchmarks.members.masks``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch

from benchmarks.arms.arms import ARMS
from benchmarks.arms.study import Study, collect, trained
from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.members.tasks import Score, episodes_of_reacher, filtered, resized
from torch_denkf import Filter, from_pretrained
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
from torch_denkf.applications.ur5.filter import UR5TableSettings
from torch_denkf.applications.ur5.train import evaluate_ur5_table
from torch_denkf.modules import StochasticMLP

MASKS = ("random", "balanced")
Scored = Callable[[Filter, int], Score]


@dataclass(frozen=True)
class Masks:
    """Compares balanced and random dropout masks in filters whose noise is dropout."""

    out: Path | None = None  # folder for masks.md
    runs: Path = Path("runs/members")  # with the manipulator's trained motion, made where missing
    tasks: tuple[Literal["reacher", "manipulator", "ur5"], ...] = ("reacher", "manipulator", "ur5")
    members: tuple[int, ...] = (32, 64, 128, 256, 512)
    draws: int = 4  # of the filter's noise
    demos: int = 200  # of the UR5
    updates: int = 8000  # of the manipulator's motion


def reacher(study: Masks) -> tuple[Callable[[int], Filter], Scored]:
    """The filter that comes with the library, by members; the score of its velocities by filter and seed."""
    shipped, data = from_pretrained("reacher"), episodes_of_reacher(10, 400, 1000)
    return partial(resized, shipped, threshold=None), lambda filter, seed: filtered(filter, data, 1, slice(2, 4), seed)


def ur5(study: Masks) -> tuple[Callable[[int], Filter], Scored]:
    """The same of the UR5's joints, on demos that its filter has not seen."""
    shipped, folder = from_pretrained("ur5-table"), study.runs / "ur5" / "test"
    collect_ur5_demos(folder, study.demos, size=(UR5TableSettings.pixels,) * 2, seed=0)

    def score(filter: Filter, seed: int) -> Score:
        torch.manual_seed(seed)
        found = evaluate_ur5_table(filter, folder, cache=study.runs / "ur5" / "cache", progress=False)
        return Score(found["filter"]["joints, deg"], found["held by 90 % intervals"])

    return partial(resized, shipped, threshold=None), score


def manipulator(study: Masks) -> tuple[Callable[[int], Filter], Scored]:
    """The same of the velocities of the filter of :mod:`benchmarks.arms`."""
    arm = ARMS["manipulator"]
    filter = trained(arm, False, Study(demos=100, motion_updates=study.updates), study.runs / "manipulator")
    data = collect(arm, False, 60, 200, 1000)

    def make(members: int) -> Filter:
        filter.initial.ensemble_size = members
        return filter

    return make, lambda filter, seed: filtered(filter, data, 1, slice(2 * arm.joints, None), seed)


def main() -> None:
    """Writes the table."""
    study = parse(Masks)
    tasks = {"reacher": reacher, "manipulator": manipulator, "ur5": ur5}
    lines = [
        "# Balanced masks",
        "",
        "Error of the velocities in rad/s, of the UR5's joints in degrees, mean and standard deviation over "
        f"{study.draws} draws of the noise, and share of the truth within the 90 % intervals. No localisation. Weights "
        "are the same.",
        "",
        *head("task", "members", *(word for masks in MASKS for word in (f"{masks} masks", "held"))),
    ]
    for name in study.tasks:
        make, score = tasks[name](study)
        for members in study.members:
            cells = []
            for masks in MASKS:
                filter = make(members)
                for module in filter.modules():
                    if isinstance(module, StochasticMLP):
                        module.balanced = masks == "balanced"
                scores = [score(filter, seed) for seed in range(study.draws)]
                error = torch.tensor([score.error for score in scores])
                held = sum(score.held for score in scores) / len(scores)
                cells += [f"{error.mean():.4f} ± {error.std():.4f}", f"{held:.1%}"]
            lines.append(line(name, members, *cells))
            print(lines[-1], flush=True)
    lines += ["", *made_by("members.masks")]
    write_page("\n".join(lines) + "\n", None if study.out is None else study.out / "masks.md")


if __name__ == "__main__":
    main()
