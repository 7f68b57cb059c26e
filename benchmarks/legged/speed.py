"""What a step costs: thousands of robots in one batch, a loop of single filters, and a packaged step.

python -m benchmarks.legged.speed --out benchmarks/legged/results
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch

from benchmarks.common.arguments import command, parse, processor
from benchmarks.common.tables import head, line, write_page
from benchmarks.legged.study import KINDS
from benchmarks.legged.task import FIRM, simulated
from torch_denkf.applications.legged import legged_filter
from torch_denkf.deployment import export_step, load_step


@dataclass(frozen=True)
class Speed:
    """What does a step of a legged robot's filter cost?"""

    out: Path | None = None  # folder for speed.md
    robots: int = 4096  # in a batch
    rounds: int = 7
    packaged: tuple[str, ...] = ("EKF",)  # which takes minutes to compile
    smoke: bool = False  # a few robots, nothing packaged


def timed(call: Callable[[], object], rounds: int, calls: int = 1) -> float:
    """Milliseconds of the processor that a call takes: the median of rounds."""
    call()
    found = []
    for _ in range(rounds):
        began = time.process_time()
        for _ in range(calls):
            call()
        found.append(1e3 * (time.process_time() - began) / calls)
    return median(found)


@torch.no_grad()
def rows(study: Speed) -> list[tuple[str, float, float, float | None]]:
    """Of each filter its name, microseconds a robot and step in a batch and alone, and milliseconds packaged."""
    robot, found = simulated("quadruped", 1, 0.1, 0, FIRM), []
    readings = robot.log[0, 5:7].select("imu", "joints", "joint_rates", "contact")
    for name, options in KINDS.items():
        filter = legged_filter(robot.model, **robot.names, dt=robot.dt, check_finite=False, **options)
        one = filter.initialise(readings[0].clone()).update(readings[1])
        many = one.expand(study.robots).clone()
        each = 1e3 * timed(lambda filter=filter, many=many: filter.step(many.copy()), study.rounds) / study.robots
        alone = 1e3 * timed(lambda filter=filter, one=one: filter.step(one.copy()), study.rounds, 10)
        packaged = _packaged(filter, one, study) if name in study.packaged and not study.smoke else None
        found.append((name, each, alone, packaged))
        print(name, found[-1], flush=True)
    return found


def _packaged(filter, one, study: Speed) -> float:
    with tempfile.TemporaryDirectory() as folder:
        step = load_step(export_step(filter, one, Path(folder) / "step.pt2"))
        entries = {".".join([key] if isinstance(key, str) else key): one[key] for key in one.keys(True, True)}
        with torch.inference_mode():
            return timed(lambda: step(entries), study.rounds, 200)


def main() -> None:
    """Measures, and writes the table."""
    study = parse(Speed)
    if study.smoke:
        study = Speed(robots=8, rounds=1, smoke=True)
    torch.manual_seed(0)
    text = [
        "# What a step costs",
        "",
        "The simulated quadruped, four feet, single precision. Times are of the processor, one thread: medians of "
        f"{study.rounds} rounds. A batch holds {study.robots:,} robots.",
        "",
        *head("filter", "batch, us a robot", "single filters in a loop, us a robot", "packaged step of one robot, ms"),
        *(line(name, f"{a:.0f}", f"{b:.0f}", "" if c is None else f"{c:.2f}") for name, a, b, c in rows(study)),
        "",
        f"* Command: `{command('legged.speed')}`.",
        f"* Hardware: {processor()}; torch {torch.__version__}.",
    ]
    write_page("\n".join(text) + "\n", None if study.out is None else study.out / "speed.md")


if __name__ == "__main__":
    main()
