"""The command line of the study: ``python -m benchmarks.ur5 --help``."""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from benchmarks.common.arguments import command, parse
from benchmarks.common.arm.beliefs import draw_beliefs
from benchmarks.common.arm.page import page
from benchmarks.common.jobs import rows_in
from benchmarks.common.tables import write_page, write_table
from benchmarks.ur5.sizes import frontier, members
from benchmarks.ur5.study import NAMES, Study, run_all
from benchmarks.ur5.training import Budget

FAIRNESS = (
    "All filters of a sensor start from the same sensor's weights and the same learned motion, and learn from the same "
    "windows of its readings with as many updates; each then trains its own copy of the sensor's head. Each has one "
    "number (a factor on the noise, or tempering of weights) chosen from the same nine values for the coverage on the "
    "same validation demos. 'sensor' is the mean of its samples; where nothing is seen its last reading stays."
)
METHOD = ("domain", "training", "sensor", "filter")


def draw(study: Study) -> list[Path]:
    """Draws the beliefs that a table saved."""
    names = [*(f"{name}, deg" for name in NAMES), "x, cm", "y, cm", "z, cm"]
    return list(draw_beliefs(study.out, names, [180 / math.pi] * len(NAMES) + [100.0] * 3, 0.08))


AFTERWARDS = {"pictures": draw, "frontier": frontier, "members": members}  # commands that read a table's folder


def smoke(study: Study) -> Study:
    """Returns a tiny study of everything, on few short demos with small images."""
    folder = Path(tempfile.mkdtemp(prefix="ur5-"))
    # Demo 9 is the first of the test demos.
    demos = {"size": 32, "demos": 12, "frames": 2, "sequences": 10, "real": 10, "real_train": 9, "steps": 30}
    budget = Budget(sensor=3, fine_tuning=2, motion=5, filter=2, end_to_end=1, length=6, batch=4)
    folders = {"root": folder / "demos", "out": folder / "out"}
    return replace(study, sizes=(4, 8), members=4, budget=budget, pasted=6, **demos, **folders)


def main() -> None:
    """Runs a command."""
    study, begun = parse(Study), time.time()
    if study.command in AFTERWARDS and not study.smoke:
        print(*AFTERWARDS[study.command](study), sep="\n")
        return
    study = smoke(study) if study.smoke else study
    try:
        study.collect(study.processes, real=study.command == "collect" or study.trainings != ("sim",))
    except (ImportError, RuntimeError) as error:
        if not study.smoke:
            raise
        print(f"skipped: no demos without OpenGL and mujoco: {error}")
        return
    if study.command == "collect":
        return
    run_all(study)
    rows = write_table(rows_in(study.out), study.out / "table.csv", (*METHOD, "condition", "ensemble_size", "seed"))
    header = f"`{command('ur5')}`: {(time.time() - begun) / 60:.0f} min"
    write_page(page(rows, METHOD, NAMES, [header, "", FAIRNESS]), study.out / "table.md")
    if study.smoke:
        for after in AFTERWARDS.values():
            print(*after(study))


if __name__ == "__main__":
    main()
