"""How long a past an innovation may correct, and which correlations it believes, with how many members.

Weights and inflation are those of the table's DEnKF; nothing is trained again. Past and threshold are to be chosen by
the folds' validation drives, column ``validation_score``: what the inflation is chosen by, too.
"""

from __future__ import annotations

from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean

import torch

from benchmarks.common.jobs import compute
from benchmarks.common.tables import Columns, head, line
from benchmarks.kitti.folds import Part
from benchmarks.kitti.frontier import WINDOW, scores
from benchmarks.kitti.readings import read_spans
from benchmarks.kitti.study import Job, Study, make_jobs
from benchmarks.kitti.tables import by_drive
from benchmarks.kitti.training import calibration_error, load_filter
from torch_denkf.applications.car.odometry.streams import all_frames
from torch_denkf.deployment.files import write_text

LAGS, THRESHOLDS = (4, 16, 64), (0.0, 1.0, 2.0, 3.0)  # steps; standard deviations, 0 believes every correlation
_IDENTITY = ("filter", "members", "lags", "threshold")
_MEANS = (
    "validation_score",
    "translation_m_per_m",
    "rotation_deg_per_m",
    "devkit_t_rel_percent",
    "crps",
    "coverage90_v",
    "coverage90_theta_dot",
)
COLUMNS = Columns(
    (*_IDENTITY, "drives", *_MEANS),
    text=_IDENTITY[:1],
    whole=("members", "lags", "drives"),
    order=lambda row: tuple(row[key] for key in _IDENTITY),
)


def compare(study: Study, command: str) -> list[Path]:
    """Tests what the table left in ``--out``; leaves past.csv and past.md there.

    Raises:
        FileNotFoundError: if no filter is trained yet.
    """
    jobs = {}
    for job in make_jobs(study):
        for name in study.filters:
            if (job.out(name) / "filter.pt").exists():
                for size in study.sizes if name == "denkf" else (1,):
                    file = study.out / "past" / f"{job.out(name).name}-{size}.json"
                    jobs[file] = partial(_rows, job, name, size)
    if not jobs:
        raise FileNotFoundError(f"no trained {', '.join(study.filters)} in {study.out / 'folds'}; run table first")
    rows = means(compute(jobs, study.processes, "past"))
    table, page = study.out / "past.csv", study.out / "past.md"
    COLUMNS.write(rows, table)
    write_text(page, markdown(rows, command))
    return [table, page]


def means(rows: list[dict]) -> list[dict]:
    """Means over the drives that are long enough, of all if none is; a row for each filter and setting."""
    long = [row for row in rows if row["window"] >= WINDOW] or rows
    found = []
    for key in dict.fromkeys(tuple(row[name] for name in _IDENTITY) for row in long):
        own = [row for row in long if tuple(row[name] for name in _IDENTITY) == key]
        drives = {column: by_drive(own, column).values() for column in _MEANS}
        row = {**dict(zip(_IDENTITY, key, strict=True)), "drives": len(drives["crps"])}
        found.append(row | {column: fmean(values) for column, values in drives.items() if values})
    return found


def chosen(rows: list[dict]) -> list[dict]:
    """Of each filter and number of members: as it was trained, and the best setting by validation."""
    found = []
    for name, members in dict.fromkeys((row["filter"], row["members"]) for row in rows):
        own = [row for row in rows if (row["filter"], row["members"]) == (name, members)]
        best = min(own, key=lambda row: row["validation_score"])
        found += [own[0]] if best is own[0] else [own[0], best]
    return found


def markdown(rows: list[dict], command: str) -> str:
    """What was chosen."""
    titles = ("past, steps", "threshold", "validation", "m/m", "deg/m", "devkit, %", "CRPS", "v held", "theta_dot held")
    lines = [
        f"`{command}`",
        "",
        "Clean test drives; past and threshold as trained, then as validation chooses.",
        "",
    ]
    lines += head("filter", "members", *titles)
    for row in chosen(rows):
        cells = [row["filter"], row["members"], row["lags"], row["threshold"] or "none"]
        cells += [f"{row.get(column, float('nan')):.3g}" for column in _MEANS]
        lines.append(line(*cells))
    return "\n".join(lines) + "\n"


def _rows(job: Job, name: str, size: int) -> list[dict]:
    """Of one trained filter, with so many members, a row for each camera of its test drive and each setting."""
    torch.set_num_threads(1)
    ensemble = name == "denkf"
    _, model, *_ = load_filter(job.out(name), size if ensemble else None)
    read = partial(read_spans, model["sensor"], cache=job.study.cache, kind=job.sensor)
    validation = [read(part) for part in job.fold.validation]
    tested = {stream.name: all_frames(read(Part(stream))) for stream in job.fold.test}
    rows = []
    told = [threshold for threshold in THRESHOLDS if threshold**2 < size - 1]  # no correlation is beyond the others
    for lags, threshold in product(LAGS, told) if ensemble else [(0, 0.0)]:
        options = {"size": size, "lags": lags, "threshold": threshold or None} if ensemble else {}
        recipe, model, *_ = load_filter(job.out(name), **options)
        setting = {"filter": name, "members": size, "lags": lags, "threshold": threshold, "seed": job.seed}
        setting["validation_score"] = calibration_error(recipe, model, validation)
        rows += [{**setting, "drive": drive, **scores(recipe, model, one)} for drive, one in tested.items()]
    return rows
