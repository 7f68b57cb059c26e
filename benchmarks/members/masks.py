"""Compares balanced with random dropout masks in the reacher's filter: ``python -m benchmarks.members.masks``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.members import tasks
from torch_denkf.modules import StochasticMLP

MASKS = ("random", "balanced")


@dataclass(frozen=True)
class Masks:
    """Compares balanced and random dropout masks in the reacher's filter."""

    out: Path | None = None  # folder for masks.md
    members: tuple[int, ...] = (32, 64, 128, 256, 512)
    draws: int = 4  # of the filter's noise


def main() -> None:
    """Writes the table."""
    study, task = parse(Masks), tasks.reacher()
    lines = [
        "# Balanced masks",
        "",
        "Error of the velocities in rad/s, mean and standard deviation over "
        f"{study.draws} draws of the noise, and share of the truth within the 90 % intervals. No localisation. Weights "
        "are the same.",
        "",
        *head("task", "members", *(word for masks in MASKS for word in (f"{masks} masks", "coverage"))),
    ]
    for members in study.members:
        cells = []
        for masks in MASKS:
            filter = task.make(members, None)
            for module in filter.modules():
                if isinstance(module, StochasticMLP):
                    module.balanced = masks == "balanced"
            scores = [task.test(filter, seed) for seed in range(study.draws)]
            error = torch.tensor([score.error for score in scores])
            held = sum(score.held for score in scores) / len(scores)
            cells += [f"{error.mean():.4f} ± {error.std():.4f}", f"{held:.1%}"]
        lines.append(line(task.name, members, *cells))
        print(lines[-1], flush=True)
    lines += ["", *made_by("members.masks")]
    write_page("\n".join(lines) + "\n", None if study.out is None else study.out / "masks.md")


if __name__ == "__main__":
    main()
