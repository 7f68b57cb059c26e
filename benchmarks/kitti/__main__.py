"""The command line of the study: ``python -m benchmarks.kitti --help``."""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import report
from benchmarks.kitti.study import Study, make_jobs, rows_of, run_jobs
from benchmarks.kitti.tables import COLUMNS, IDENTITY, markdown
from benchmarks.kitti.training import Budget
from torch_denkf.applications.car import write_drives
from torch_denkf.deployment.files import write_text


def smoke(study: Study) -> Study:
    """Returns a tiny study of everything, on four small rendered drives."""
    folder = Path(tempfile.mkdtemp(prefix="kitti-"))
    names = tuple(write_drives(folder / "kitti", ["a", "b", "c", "d"], frames=20, seed=0))
    budget = Budget(sensor=3, fine_tuning=2, filter=2, end_to_end=2, length=8)
    settings = {"size": (25, 75), "seeds": 1, "processes": 1, "drives": names, "test": names[:1], "budget": budget}
    return replace(study, root=folder / "kitti", out=folder / "out", sensors=("flow", "image"), **settings)


def main() -> None:
    """Trains and tests every filter and sensor on every fold."""
    study = parse(Study)
    if study.smoke:
        study = smoke(study)
    if study.root is None:
        raise SystemExit("--root is missing: the folder with 'sequences' and 'poses' (or --smoke)")
    study.out.mkdir(parents=True, exist_ok=True)
    begun = time.time()
    jobs = make_jobs(study)
    write_text(study.out / "settings.json", json.dumps(asdict(study), indent=1, default=str))
    run_jobs(jobs, study.processes)
    rows = rows_of(study.out)
    header = f"`{command('kitti')}`: {(time.time() - begun) / 60:.0f} min, {study.processes} process(es)"
    report(study.out, rows, markdown(rows, header), order=IDENTITY, columns=COLUMNS)


if __name__ == "__main__":
    main()
