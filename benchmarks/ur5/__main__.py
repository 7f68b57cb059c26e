"""The command line of the study: ``python -m benchmarks.ur5 --help``."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import report
from benchmarks.ur5.frontier import draw
from benchmarks.ur5.members import run as members
from benchmarks.ur5.pictures import draw_all
from benchmarks.ur5.study import Study, rows_of, run_all
from benchmarks.ur5.tables import COLUMNS, markdown
from benchmarks.ur5.training import Budget

# What reads a table's folder.
AFTERWARDS = {"pictures": lambda study: draw_all(study.out), "frontier": draw, "members": members}


def smoke(study: Study) -> Study:
    """Everything once, on few short demos with small pictures."""
    folder = Path(tempfile.mkdtemp(prefix="ur5-"))
    # Demo 9 is the first that is tested on.
    demos = {"size": 32, "demos": 12, "frames": 2, "sequences": 10, "real": 10, "real_train": 9, "steps": 30}
    budget = Budget(sensor=3, fine_tuning=2, motion=5, filter=2, end_to_end=1, length=6, batch=4)
    folders = {"root": folder / "demos", "out": folder / "out"}
    return replace(
        study, sensors=("glimpse", "paper"), sizes=(4, 8), members=4, budget=budget, pasted=6, **demos, **folders
    )


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
    rows = rows_of(study.out)
    header = f"`{command('ur5')}`: {(time.time() - begun) / 60:.0f} min"
    report(study.out, COLUMNS, rows, markdown(rows, header))
    if study.smoke:
        for after in AFTERWARDS.values():
            print(*after(study))


if __name__ == "__main__":
    main()
