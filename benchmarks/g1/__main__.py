"""The command line of the study: ``python -m benchmarks.g1 --help``."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path

from benchmarks.common.arguments import command, parse
from benchmarks.common.arm.beliefs import draw_beliefs
from benchmarks.common.arm.page import page
from benchmarks.common.jobs import rows_in
from benchmarks.common.tables import write_page, write_table
from benchmarks.g1.base import SensorBudget, TrainedSensor
from benchmarks.g1.recordings import NAMES
from benchmarks.g1.study import FilterBudget, Study, diagnosis, run_all

FAIRNESS = (
    "All filters of a seed read the same sensor, begin with the same learned motion, and learn from the same windows "
    "with as many updates (the LSTM, which knows no motion, with six times as many). Each has one number (a factor on "
    "the noise, or tempering of weights) chosen from the same seven values for the coverage on the same validation "
    "episodes, over all conditions. `sensor` reads every picture, repeats too, and knows the mean pose alone where "
    "none arrives; `held` is the sensor with a zero-order hold."
)


def smoke(study: Study) -> Study:
    """Returns a tiny study of everything, on small synthetic images."""
    tiny = {"drawn": True, "size": (36, 48), "tune": 3, "validation": 2, "seeds": (0,)}
    budget = FilterBudget(motion=5, spread=20, filter=2, length=6, batch=4)
    out = Path(tempfile.mkdtemp(prefix="g1-"))
    return replace(study, out=out, budget=budget, sensor_budget=SensorBudget(updates=3, frames=4), **tiny)


def main() -> None:
    """Runs a command."""
    study = parse(Study)
    study = smoke(study) if study.smoke else study
    if study.command == "table":
        run_all(study)
        rows = write_table(rows_in(study.out), study.out / "table.csv", ("filter", "condition", "seed"))
        text = page(rows, ["filter"], NAMES, [f"`{command('g1')}`", "", FAIRNESS])
        write_page(text, study.out / "table.md")
    if study.command == "diagnosis" or study.smoke:
        sensors = [TrainedSensor(study, seed, study.sensor_budget) for seed in study.seeds]
        write_page("\n".join(map(diagnosis, sensors)) + "\n", study.out / "diagnosis.md")
    if study.command == "pictures" or study.smoke:
        names = [f"{name.replace('_', ' ')}, deg" for name in NAMES]
        print(*draw_beliefs(study.out, names, [180 / math.pi] * len(names), 1 / study.data.fps), sep="\n")


if __name__ == "__main__":
    main()
