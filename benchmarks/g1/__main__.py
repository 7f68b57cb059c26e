"""The command line of the study: ``python -m benchmarks.g1 --help``."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import report
from benchmarks.g1.base import SensorBudget
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
        sensor_budget=SensorBudget(glimpse=3, paper=2, frames=4),
        budget=FilterBudget(motion=5, filter=2, length=6, batch=4),
    )


def main() -> None:
    """Runs a command."""
    study, begun = parse(Study), time.time()
    study = smoke(study) if study.smoke else study
    if study.command == "table":
        run_all(study)
        rows = rows_in(study.out)
        header = f"`{command('g1')}`: {(time.time() - begun) / 60:.0f} min"
        report(study.out, COLUMNS, rows, markdown(rows, header))
    if study.command == "pictures" or study.smoke:
        print(*draw_all(study), sep="\n")


if __name__ == "__main__":
    main()
