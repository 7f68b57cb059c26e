"""Evaluates trained filters with other ensemble sizes: error against milliseconds per step, and localisation."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product
from pathlib import Path

import pandas as pd

from benchmarks.common.arm.readings import read_all
from benchmarks.common.arm.scores import coverage, filter_error, run_filter
from benchmarks.common.jobs import once, read_rows
from benchmarks.common.plots import draw_frontier
from benchmarks.common.tables import markdown, write_page, write_table
from benchmarks.common.training import coverage_error, read_filter
from benchmarks.ur5.recipes import UR5Recipe
from benchmarks.ur5.sensors import MEMBERS
from benchmarks.ur5.study import Base, Study, members_of, sensor_rows, size_row, trained
from benchmarks.ur5.training import INFLATIONS, with_missing
from torch_denkf.training import choose

SCHEMES = ("sensor", "perturbed", "sakov")  # of the DEnKF's update; "etkf" supports no localisation
SHOWN = 3.0  # degrees, largest error in the plot
KINDS = ("none", "factors", "significance", "both")  # of localisation
THRESHOLDS = (1.0, 1.5, 2.0, 3.0)


def frontier(study: Study) -> list[Path]:
    """Draws error against milliseconds per step of the table's filters in ``--out``: frontier.csv, frontier.png.

    Nothing is trained again. For an update that a filter was not trained with, the inflation is chosen as in training,
    with the table's number of members.
    """
    for seed in study.seeds:
        base = Base(study, study.sensors[0], "sim", seed)
        for name in study.filters:
            file = study.out / "frontier" / f"{name}-{base.name}.json"
            once(file, lambda base=base, name=name: list(_frontier(base, name)))
    rows = read_rows(sorted((study.out / "frontier").glob("*.json")))
    files = [study.out / f"frontier.{kind}" for kind in ("csv", "png")]
    write_table(rows, files[0], ("sensor", "filter", "members", "seed"))
    draw_frontier(rows, files[1], error="joint_mae_deg", label="joints, mean absolute error, deg", limit=SHOWN)
    return files


def _frontier(base: Base, name: str) -> Iterator[dict]:
    saved, chunk = trained(base, name), 0 if base.study.smoke else 1
    for scheme in SCHEMES if name == "denkf" else (None,):
        names = {"filter": f"DEnKF, {scheme}" if scheme else name, "sensor": base.kind, "seed": base.seed}

        def make(size: int, scheme: str | None = scheme) -> UR5Recipe:
            recipe = base.recipe(name, size)
            recipe.scheme = scheme or recipe.scheme
            return recipe

        own = {**saved, "inflation": _inflation(base, make(MEMBERS), saved)} if scheme in SCHEMES[1:] else saved
        for size in base.study.sizes if scheme else (MEMBERS,):
            yield {**size_row(base, make(size), own, names, chunk), "members": size if scheme else members_of(name)}


def _inflation(base: Base, recipe: UR5Recipe, saved: dict) -> float:
    """Chooses the inflation of a recipe's update, by the validation demos' coverage."""
    model, readings = read_filter(recipe, recipe.build(), saved), with_missing(recipe, base.codes("validation"))
    apply = partial(recipe.set_inflation, model)
    return choose(INFLATIONS, apply, lambda: coverage_error(coverage(run_filter(recipe, model, readings))))


def members(study: Study) -> list[Path]:
    """Tests the DEnKF with other ensemble sizes and localisations: members.csv and members.md in ``--out``.

    Filters are trained once each, with few members.
    The validation demos choose the threshold; the factor on the noise stays that of the training.
    """
    for kind in study.sensors:
        base = Base(study, kind, "sim", study.seeds[0])
        once(study.out / "members" / f"sensor-{base.name}.json", lambda base=base: _sensor_alone(base))
        for trained_by, size in product(study.localisations, study.sizes):
            file = study.out / "members" / f"{trained_by}-{study.members}-{base.name}-{size}.json"
            once(file, partial(_members, base, trained_by, size))
    rows = read_rows(sorted((study.out / "members").glob("*.json")))
    files = [study.out / f"members.{kind}" for kind in ("csv", "md")]
    frame = write_table(rows, files[0], ("sensor", "trained", "members"))
    write_page(members_page(frame), files[1])
    return files


def members_page(frame: pd.DataFrame) -> str:
    """Returns a table of the rows, with a column for each localisation."""
    frame = frame.assign(cell=[_cell(row) for row in frame.to_dict("records")])
    table = frame.set_index(["sensor", "trained", "members", "localisation"])["cell"].unstack("localisation")
    text = "Clean test demos. Cells: joints, deg / end effector, cm / coverage of 90 %, and the threshold, if any."
    return "\n".join(["# How many members?", "", text, "", *markdown(table[list(KINDS)])]) + "\n"


def _cell(row: dict) -> str:
    if row["joint_mae_deg"] > 180:
        return "diverges"
    threshold = f" ({row['threshold']:g})" if row["threshold"] > 0 else ""
    return f"{row['joint_mae_deg']:.2f} / {row['ee_mae_cm']:.2f} / {row['coverage90']:.0%}{threshold}"


def _sensor_alone(base: Base) -> list[dict]:
    readings = {"clean": read_all([base.sensor], base.codes("test"), MEMBERS)}
    names = {"sensor": base.kind, "trained": "its sensor alone", "localisation": "none"}
    return [{**row, "members": MEMBERS, "threshold": 0.0} for row in sensor_rows(base.preset, readings, names)]


def _members(base: Base, trained_by: str, size: int) -> list[dict]:
    study, rows = base.study, []

    def make(kind: str, threshold: float | None, size: int) -> UR5Recipe:
        recipe = base.recipe("denkf", size)
        recipe.factors, recipe.threshold = kind in ("factors", "both"), threshold
        return recipe

    first = make(trained_by, study.threshold if trained_by in KINDS[2:] else None, study.members)
    saved = trained(base, f"denkf-{trained_by}-{study.members}", first)
    for kind in KINDS:
        crps = {}
        for threshold in [t for t in THRESHOLDS if t**2 < size - 1] if kind in KINDS[2:] else [None]:
            other = make(kind, threshold, size)
            model = read_filter(other, other.build(), saved)
            crps[threshold] = filter_error(other, model, with_missing(other, base.codes("validation")))["crps"]
        threshold = min(crps, key=crps.__getitem__)
        names = {"sensor": base.kind, "trained": f"{trained_by}, {study.members}", "localisation": kind}
        row = size_row(base, make(kind, threshold, size), saved, names)
        rows.append({**row, "members": size, "threshold": threshold or 0.0})
    return rows
