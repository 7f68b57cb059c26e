"""The tables of the study, from the rows of its episodes: ``python -m benchmarks.arms.page table.csv``."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

from benchmarks.common.intervals import bootstrap_interval
from benchmarks.common.tables import markdown

SOURCES = ("encoders", "pixels")
CASE = ["task", "source", "missing"]
SCORES = {
    "angle": "angles, deg",
    "velocity": "velocities, rad/s",
    "tip": "tip to goal, cm",
    "error": "error of tip, cm",
    "offset": "of it constant, cm",
    "return": "return",
    "effort": "effort",
}


def difference(rows: pd.DataFrame, name: str) -> str:
    """Returns the mean difference of belief and readings in the same episodes, its interval, and its share."""
    wide = rows.pivot(index=["seed", "episode"], columns="estimate", values=name)
    center, low, high = bootstrap_interval((wide["belief"] - wide["reading"]).to_numpy())
    return f"{center:+.2f} [{low:+.2f}, {high:+.2f}], {center / wide['reading'].mean():+.0%}"


def page(rows: pd.DataFrame) -> str:
    """Returns the tables of all tasks and sources in the rows."""
    shown = {name: SCORES[name] for name in ("angle", "tip", "velocity", "effort")}
    cases = {case: [difference(own, name) for name in shown] for case, own in rows.groupby(CASE, sort=False)}
    compared = pd.DataFrame.from_dict(cases, orient="index", columns=list(shown.values()))
    compared.index = pd.MultiIndex.from_tuples(cases, names=CASE)
    said = "Belief minus readings, in the same episodes: mean, its 95 % interval, and its share of the readings' mean."
    groups = rows.groupby([*CASE, "estimate"], sort=False)[list(SCORES)]
    mean, error = groups.mean(), groups.sem()
    cells = mean.map("{:.2f}".format) + " ± " + error.map("{:.2f}".format)
    seconds = rows.groupby([*CASE[:2]], sort=False)["cpu_s"].mean().map("{:.0f}".format).to_frame("s of one core")
    tables = [compared, cells.rename(columns=SCORES), seconds]
    return "\n".join([said, *(line for table in tables for line in ("", *markdown(table)))]) + "\n"


if __name__ == "__main__":
    print(page(pd.read_csv(Path(sys.argv[1]))))
