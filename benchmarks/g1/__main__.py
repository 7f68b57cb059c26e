"""The command line of the study: ``python -m benchmarks.g1 --help``."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import report, write_page
from benchmarks.g1.base import SensorBudget, TrainedSensor
from benchmarks.g1.diagnosis import diagnose
from benchmarks.g1.pictures import draw_all
from benchmarks.g1.study import Study, rows_in, run_all
from benchmarks.g1.tables import COLUMNS, markdown
from benchmarks.g1.training import FilterBudget


def smoke(study: Study) -> Study:
    """Everything once, on a drawn robot with small pictures."""
    return replace(
        study,
        out=Path(tempfile.mkdtemp(prefix="g1-")),
        drawn=True,
        size=(36, 48),
        tune=3,
        validation=2,
        seeds=(0,),
        sensor_budget=SensorBudget(updates=3, frames=4),
        budget=FilterBudget(motion=5, filter=2, length=6, batch=4),
    )


def main() -> None:
    """Runs a command."""
    study = parse(Study)
    study = smoke(study) if study.smoke else study
    if study.command == "table":
        run_all(study)
        rows = rows_in(study.out)
        report(study.out, COLUMNS, rows, markdown(rows, f"`{command('g1')}`"))
    if study.command == "diagnosis" or study.smoke:
        sensors = [TrainedSensor(study, seed, study.sensor_budget) for seed in study.seeds]
        write_page("\n".join(map(diagnose, sensors)) + "\n", study.out / "diagnosis.md")
    if study.command == "pictures" or study.smoke:
        print(*draw_all(study), sep="\n")


if __name__ == "__main__":
    main()
