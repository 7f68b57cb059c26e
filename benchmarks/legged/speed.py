"""Times a filter's step: thousands of robots in one batch, a loop of single filters, and a packaged step.

python -m benchmarks.legged.speed --out benchmarks/legged/results
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.scores import processor_ms
from benchmarks.common.tables import markdown, write_page
from benchmarks.legged.study import KINDS
from benchmarks.legged.task import FIRM, simulated
from torch_denkf.applications.legged import legged_filter
from torch_denkf.deployment import export_step, load_step


@dataclass(frozen=True)
class Speed:
    """Times a step of a legged robot's filter."""

    out: Path | None = None  # folder for speed.md
    robots: int = 4096  # in a batch
    rounds: int = 7
    packaged: tuple[str, ...] = ("EKF",)  # filters to package, which takes minutes
    smoke: bool = False  # a few robots, nothing packaged


@torch.no_grad()
def rows(study: Speed) -> pd.DataFrame:
    """Times each filter: microseconds per robot and step, in a batch and alone, and milliseconds packaged."""
    robot, found = simulated("quadruped", 1, 0.1, 0, FIRM), {}
    readings = robot.log[0, 5:7].select("imu", "joints", "joint_rates", "contact")
    for name, options in KINDS.items():
        filter = legged_filter(robot.model, **robot.names, dt=robot.dt, check_finite=False, **options)
        one = filter.initialise(readings[0].clone()).update(readings[1])
        many = one.expand(study.robots).clone()
        cells = [
            f"{1e3 * processor_ms(lambda filter=filter, at=at: filter.step(at.copy()), steps, study.rounds):.0f}"
            for at, steps in ((many, study.robots), (one, 1))
        ]
        packaged = name in study.packaged and not study.smoke
        found[name] = [*cells, f"{_packaged(filter, one, study.rounds):.2f}" if packaged else ""]
        print(name, found[name], flush=True)
    heads = "batch, us a robot", "single filters in a loop, us a robot", "packaged step of one robot, ms"
    return pd.DataFrame.from_dict(found, orient="index", columns=heads).rename_axis("filter")


def _packaged(filter, one, rounds: int) -> float:
    with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
        step = load_step(export_step(filter, one, Path(folder) / "step.pt2"))
        entries = {".".join([key] if isinstance(key, str) else key): one[key] for key in one.keys(True, True)}
        return processor_ms(lambda: [step(entries) for _ in range(200)], 200, rounds)


def main() -> None:
    """Measures, and writes the table."""
    study = parse(Speed)
    study = Speed(robots=8, rounds=1, smoke=True) if study.smoke else study
    torch.manual_seed(0)
    text = [
        "# Time of a step",
        "",
        "The simulated quadruped, four feet, single precision. Times are of the processor, one thread: the least of "
        f"{study.rounds} rounds. A batch holds {study.robots:,} robots.",
        "",
        *markdown(rows(study)),
        "",
        *made_by("legged.speed"),
    ]
    write_page("\n".join(text) + "\n", None if study.out is None else study.out / "speed.md")


if __name__ == "__main__":
    main()
