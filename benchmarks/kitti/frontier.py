"""Error against milliseconds a step: the trained DEnKF at all sizes and with three updates, and the other filters.

Weights and inflation are those of the table's filters; nothing is trained again. Size and update are chosen by the
folds' validation drives, column ``validation_score``: what the inflation is chosen by, too.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from statistics import fmean

import torch
from tensordict import TensorDict

from benchmarks.common.jobs import once, read_rows
from benchmarks.common.plots import draw_frontier
from benchmarks.common.scores import belief_crps, processor_ms
from benchmarks.common.tables import Columns
from benchmarks.kitti.evaluation import DRAWS, TIMED, calibration, errors
from benchmarks.kitti.folds import VELOCITIES, Part
from benchmarks.kitti.readings import read_spans
from benchmarks.kitti.recipes import KITTIRecipe
from benchmarks.kitti.study import Job, Study, make_jobs
from benchmarks.kitti.tables import by_drive
from benchmarks.kitti.training import FLOOR, calibration_error, load_filter, run_filter
from torch_denkf.applications.car.odometry.batches import mark_start
from torch_denkf.applications.car.odometry.streams import all_frames
from torch_denkf.filters import Filter

SCHEMES = ("sensor", "perturbed", "sakov")  # of the DEnKF's update; "etkf" takes no localisation
WINDOW = 100  # steps
ERRORS = {"translation_m_per_m": f"end point error over {WINDOW} steps, m/m", "crps": "CRPS, in a good sensor's errors"}
_SCORES = ("translation_m_per_m", "rotation_deg_per_m", "devkit_t_rel_percent", "coverage90_v", "coverage90_theta_dot")
_IDENTITY = ("filter", "sensor", "members")
_MEANS = ("validation_score", "crps", *_SCORES, "ms_per_step", "eager_ms_per_step")
COLUMNS = Columns(
    (*_IDENTITY, "drives", *_MEANS),
    text=_IDENTITY[:2],
    whole=("members", "drives"),
    order=lambda row: (row["sensor"], row["filter"], row["members"]),
)


def draw(study: Study) -> list[Path]:
    """Times and tests what the table left in ``--out``; leaves frontier.csv and two pictures there.

    Raises:
        FileNotFoundError: if no filter is trained yet.
    """
    timed, files = set(), []
    for job in make_jobs(study):
        for name in study.filters:
            if (job.out(name) / "filter.pt").exists():
                times = (name, job.sensor) not in timed  # which weights it has takes no time
                timed.add((name, job.sensor))
                for size in study.sizes if name == "denkf" else (None,):
                    file = study.out / "frontier" / f"{job.out(name).name}-{size or 'as-trained'}.json"
                    once(file, partial(_rows, job, name, size, times))
                    files.append(file)
    if not files:
        folder = study.out / "folds"
        raise FileNotFoundError(f"no trained {', '.join(study.filters)} in {folder}; run table with this --out first")
    rows = means(read_rows(files))
    table = study.out / "frontier.csv"
    COLUMNS.write(rows, table)
    pictures = [study.out / f"frontier{suffix}.png" for suffix in ("", "_crps")]
    for picture, (error, label) in zip(pictures, ERRORS.items(), strict=True):
        draw_frontier(rows, picture, error=error, label=label)
    return [table, *pictures]


def means(rows: list[dict]) -> list[dict]:
    """Means over the drives that are long enough, of all if none is; a row for each filter, sensor and size."""
    long = [row for row in rows if row["window"] >= WINDOW] or rows
    found = []
    for key in dict.fromkeys(tuple(row[name] for name in _IDENTITY) for row in long):
        own = [row for row in long if tuple(row[name] for name in _IDENTITY) == key]
        drives = {column: by_drive(own, column).values() for column in _MEANS}
        row = {**dict(zip(_IDENTITY, key, strict=True)), "drives": len(drives["crps"])}
        found.append(row | {column: fmean(values) for column, values in drives.items() if values})
    return found


def _rows(job: Job, name: str, size: int | None, times: bool) -> list[dict]:
    """Of one trained filter, with so many members, a row for each camera of its test drive and each update."""
    torch.set_num_threads(1)
    _, model, _, kind = load_filter(job.out(name), size)
    validation = [_read(job, model, part) for part in job.fold.validation]
    tested = {stream.name: all_frames(_read(job, model, Part(stream))) for stream in job.fold.test}
    rows = []
    for scheme in SCHEMES if size else (None,):
        options = {"size": size, "scheme": scheme} if size else {}
        recipe, model, *_ = load_filter(job.out(name), **options)
        names = {"filter": f"DEnKF, {scheme}" if size else name, "sensor": kind, "seed": job.seed}
        names["members"] = size or getattr(recipe, "particles", 1)
        names["validation_score"] = calibration_error(recipe, model, validation)
        for drive, reading in tested.items():
            row = {**names, "drive": drive, **scores(recipe, model, reading)}
            rows.append(row | (processor_times(recipe, model, reading, job.study.smoke) if times else {}))
    return rows


def _read(job: Job, model: Filter, part: Part) -> TensorDict:
    return read_spans(model["sensor"], part, job.study.cache, job.sensor)


def scores(recipe: KITTIRecipe, model: Filter, reading: TensorDict) -> dict[str, float]:
    """Errors over 100 steps, or the longest window that the drive has, CRPS and coverage; means over draws."""
    rows = []
    for draw in range(DRAWS):
        belief = run_filter(recipe, model, [reading], seed=draw)[0]
        paths = errors(belief["belief", "mean"][:, :5].double(), belief["state"].double())
        path = max((row for row in paths if row["window"] <= WINDOW), key=lambda row: row["window"])
        crps = float(belief_crps(belief, VELOCITIES, recipe.unit, FLOOR).mean())
        rows.append({"window": path["window"], "crps": crps, **path, **calibration(belief)})
    kept = [column for column in (*_SCORES, "crps") if column in rows[0]]
    return {"window": rows[0]["window"]} | {column: fmean(row[column] for row in rows) for column in kept}


def processor_times(recipe: KITTIRecipe, model: Filter, reading: TensorDict, smoke: bool) -> dict[str, float]:
    """Milliseconds of the processor a step behind the sensor, eager and compiled; in a smoke both are eager."""
    row, behind, times = mark_start(reading[None, :TIMED]), recipe.part(model, sensor=False), {}
    for column, chunk in (("eager_ms_per_step", 0), ("ms_per_step", 0 if smoke else 1)):
        behind.compile(chunk=chunk)
        times[column] = processor_ms(lambda: behind.sequence(row.copy()), row.shape[1])
    return times
