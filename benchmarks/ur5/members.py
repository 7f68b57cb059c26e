"""Counts the members that the DEnKF needs: without localisation, with factors on covariances, with significance.

Filters are trained once each, with few members, and tested with other numbers of members and other localisations.
The validation demos choose the threshold; the factor on the noise stays that of the training.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from benchmarks.common.jobs import once, read_rows
from benchmarks.common.tables import Columns, head, line, pick, write_page
from benchmarks.common.training import read_filter
from benchmarks.ur5.evaluation import sensor_rows, size_rows
from benchmarks.ur5.readings import read_all, with_missing
from benchmarks.ur5.recipes import UR5Recipe
from benchmarks.ur5.sensors import MEMBERS
from benchmarks.ur5.study import Base, Study
from benchmarks.ur5.training import filter_error
from torch_denkf.training.checkpoint import read_checkpoint

KINDS = ("none", "factors", "significance", "both")
ALONE = "its sensor alone"
THRESHOLDS = (1.0, 1.5, 2.0, 3.0)
COLUMNS = Columns(
    (
        *("sensor", "trained", "localisation", "members", "threshold"),
        *("validation_crps", "joint_mae_deg", "ee_mae_cm", "coverage90", "ms_per_step", "demos"),
    ),
    text=("sensor", "trained", "localisation"),
    whole=("members", "demos"),
    order=lambda row: (row["sensor"], row["trained"], row["members"], KINDS.index(row["localisation"])),
)


def run(study: Study) -> list[Path]:
    """Trains and tests; leaves members.csv and members.md in ``--out``."""
    for kind in study.sensors:
        base = Base(study, kind, "sim", study.seeds[0])
        once(study.out / "members" / f"sensor-{base.name}.json", lambda base=base: _sensor(base))
        for trained in study.localisations:
            for size in study.sizes:
                file = study.out / "members" / f"{trained}-{study.members}-{base.name}-{size}.json"
                once(file, lambda base=base, trained=trained, size=size: list(_rows(base, trained, size)))
    rows = read_rows(sorted((study.out / "members").glob("*.json")))
    files = [study.out / f"members.{kind}" for kind in ("csv", "md")]
    COLUMNS.write(rows, files[0])
    write_page(page(rows), files[1])
    return files


def _sensor(base: Base) -> list[dict]:
    readings = {"clean": read_all(base.sensor, base.codes("test"), MEMBERS)}
    names = {"sensor": base.kind, "trained": ALONE, "localisation": "none", "members": MEMBERS}
    return [{key: row[key] for key in COLUMNS.names if key in row} for row in sensor_rows(base.preset, readings, names)]


def recipe_of(base: Base, kind: str, threshold: float | None, size: int) -> UR5Recipe:
    """The DEnKF with one of the localisations."""
    recipe = base.recipe("denkf", size)
    recipe.factors, recipe.threshold = kind in ("factors", "both"), threshold
    return recipe


def _rows(base: Base, trained: str, size: int) -> Iterator[dict]:
    study, name = base.study, f"denkf-{trained}-{base.study.members}"
    first = recipe_of(base, trained, study.threshold if trained in KINDS[2:] else None, study.members)
    recipe, _, out = base.train(name, first)
    saved, validation = read_checkpoint(out / "filter.pt"), base.codes("validation")
    readings = with_missing(read_all(recipe.sensor, validation, size))
    for kind in KINDS:
        crps = {}
        for threshold in thresholds_of(kind, size):
            other = recipe_of(base, kind, threshold, size)
            crps[threshold] = filter_error(other, read_filter(other, other.build(), saved), readings)["crps"]
        threshold = min(crps, key=crps.__getitem__)
        make = partial(recipe_of, base, kind, threshold)
        names = {"sensor": base.kind, "trained": f"{trained}, {study.members}", "localisation": kind, "members": size}
        (row,) = size_rows(make, recipe.sensor, base.codes("test"), [size], saved, names, validation)
        row["threshold"] = threshold or 0.0
        print(row, crps, flush=True)
        yield {column: row[column] for column in COLUMNS.names}


def thresholds_of(kind: str, size: int) -> Sequence[float | None]:
    """Returns the thresholds that so many members can show."""
    return [value for value in THRESHOLDS if value**2 < size - 1] if kind in KINDS[2:] else [None]


def page(rows: Sequence[dict]) -> str:
    """A table for each sensor and each filter that was trained."""
    lines = [
        "# How many members?",
        "",
        "Clean test demos. Cells: joints deg / end effector cm / share of the true joints in the 90 % intervals, and",
        "the threshold, if any.",
    ]
    for sensor, trained in dict.fromkeys((row["sensor"], row["trained"]) for row in rows if row["trained"] != ALONE):
        own, alone = (pick(rows, sensor=sensor, trained=name) for name in (trained, ALONE))
        title = f"**{sensor}**, trained with {trained} members; {ALONE}: {_cell(alone)}"
        lines += ["", title, "", *head("members", *KINDS)]
        for size in sorted({row["members"] for row in own}):
            lines.append(line(size, *(_cell(pick(own, members=size, localisation=kind)) for kind in KINDS)))
    return "\n".join(lines) + "\n"


def _cell(rows: Sequence[dict]) -> str:
    if not rows:
        return ""
    (row,) = rows
    if row["joint_mae_deg"] > 180:
        return "diverges"
    threshold = f" ({row['threshold']:g})" if row.get("threshold") else ""
    return f"{row['joint_mae_deg']:.2f} / {row['ee_mae_cm']:.2f} / {row['coverage90']:.0%}{threshold}"
