"""Dropout masks that are balanced over the members against independent ones: ``python -m benchmarks.members.masks``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict

from benchmarks.arms.arms import ARMS
from benchmarks.arms.study import Study, collect, trained
from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.members.tasks import Score, episodes_of_reacher, filtered, resized
from torch_denkf import Filter, from_pretrained
from torch_denkf.modules import StochasticMLP

MASKS = ("random", "balanced")


@dataclass(frozen=True)
class Masks:
    """Compares balanced and random dropout masks in filters whose noise is dropout."""

    out: Path | None = None  # folder for masks.md
    runs: Path = Path("runs/members")  # with the manipulator's trained motion, made where missing
    tasks: tuple[Literal["reacher", "manipulator"], ...] = ("reacher", "manipulator")
    members: tuple[int, ...] = (32, 64, 128, 256, 512)
    draws: int = 4  # of the filter's noise


def reacher() -> tuple[Callable[[int], Filter], TensorDict, slice]:
    """The filter that comes with the library, by members; test episodes; which parts of the state are velocities."""
    shipped = from_pretrained("reacher")
    return partial(resized, shipped, threshold=None), episodes_of_reacher(10, 400, 1000), slice(2, 4)


def manipulator(folder: Path) -> tuple[Callable[[int], Filter], TensorDict, slice]:
    """The same of the filter of :mod:`benchmarks.arms`."""
    arm = ARMS["manipulator"]
    filter = trained(arm, False, Study(demos=100, motion_updates=8000), folder)

    def make(members: int) -> Filter:
        filter.initial.ensemble_size = members
        return filter

    return make, collect(arm, False, 60, 200, 1000), slice(2 * arm.joints, None)


def main() -> None:
    """Writes the table."""
    study = parse(Masks)
    tasks = {"reacher": reacher, "manipulator": partial(manipulator, study.runs / "manipulator")}
    lines = [
        "# Balanced masks",
        "",
        f"Error of the velocities in rad/s, mean and standard deviation over {study.draws} draws of the noise, "
        "and share of the truth within the 90 % intervals. No localisation. Weights are the same.",
        "",
        *head("task", "members", *(word for masks in MASKS for word in (f"{masks} masks", "held"))),
    ]
    for name in study.tasks:
        make, data, dims = tasks[name]()
        for members in study.members:
            cells = []
            for masks in MASKS:
                filter = make(members)
                for module in filter.modules():
                    if isinstance(module, StochasticMLP):
                        module.balanced = masks == "balanced"
                scores: list[Score] = [filtered(filter, data, 1, dims, seed) for seed in range(study.draws)]
                error = torch.tensor([score.error for score in scores])
                held = sum(score.held for score in scores) / len(scores)
                cells += [f"{error.mean():.4f} ± {error.std():.4f}", f"{held:.1%}"]
            lines.append(line(name, members, *cells))
            print(lines[-1], flush=True)
    lines += ["", *made_by("members.masks")]
    write_page("\n".join(lines) + "\n", None if study.out is None else study.out / "masks.md")


if __name__ == "__main__":
    main()
