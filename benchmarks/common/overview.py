"""Bars for the pages of results, drawn from the studies' rows: ``python -m benchmarks.common.overview``."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean, median

from benchmarks.common.plots import plt, save
from benchmarks.common.tables import pick

STUDIES = Path(__file__).parents[1]
PAGES = STUDIES.parent / "docs" / "results"
Bars = dict[str, dict[str, float]]  # of each row, by what the row is: a number of each series


def rows_of(file: str) -> list[dict]:
    """Rows of a CSV of a study; cells stay text."""
    return list(csv.DictReader((STUDIES / file).open()))


def mean(rows: Sequence[dict], name: str) -> float:
    """Returns the mean of a column."""
    return fmean(float(row[name]) for row in rows)


def smoothing() -> tuple[str, Bars]:
    """Error of filter and smoother on chaotic systems; methods without a smoother are left out."""
    rows = [row for row in rows_of("smoothing/results/smoothing.csv") if row["rmse_smoother"]]
    cases = dict.fromkeys((row["system"], row["method"], row["lag"]) for row in rows)
    bars = {}
    for system, method, lag in cases:
        some = pick(rows, system=system, method=method, lag=lag)
        name = f"{system}, {method}" + (f", lag {lag}" if lag else "")
        bars[name] = {"filter": mean(some, "rmse_filter"), "smoother": mean(some, "rmse_smoother")}
    return "root mean square error", bars


def fusion() -> tuple[str, Bars]:
    """Error on KITTI while a sensor fails, median over the trainings."""
    rows = [row for row in rows_of("fusion/results/fusion.csv") if row["task"] == "KITTI" and row["error_without"]]
    bars = {}
    for condition in dict.fromkeys(row["condition"] for row in rows):
        plain, weights = (pick(rows, condition=condition, method=method) for method in ("plain", "weights"))
        bars[condition] = {
            "plain": median(float(row["error"]) for row in plain),
            "weights": median(float(row["error"]) for row in weights),
            "without that sensor": median(float(row["error_without"]) for row in weights),
        }
    return "car: error while a sensor fails, m", bars


def monitor() -> tuple[str, Bars]:
    """Error of the path's end, alone and with an answer to the signs."""
    rows = [row for row in rows_of("monitor/results/monitor.csv") if row["m_per_m"]]
    named = {"none": "no fault", "black-all": "30 % black", "box-all": "a box"}
    return "car: error of the path's end, m/m", {
        f"{row['task'].removeprefix('kitti-')}: {named[row['fault']]}": {
            "alone": float(row["m_per_m"]),
            "with an answer": float(row["m_per_m_gated"]),
        }
        for row in rows
    }


def arms() -> tuple[str, Bars]:
    """Mean distance of an arm's tip from its goal."""
    rows = rows_of("arms/results/table.csv")
    bars = {}
    for task, source, missing in dict.fromkeys((row["task"], row["source"], row["missing"]) for row in rows):
        some = pick(rows, task=task, source=source, missing=missing)
        name = f"{task}, {source}" + (f", {float(missing):.0%} missing" if float(missing) else "")
        bars[name] = {read: mean(pick(some, estimate=read), "tip") for read in ("reading", "belief")}
    return "tip to goal, cm", bars


def odometry() -> tuple[str, Bars]:
    """Length of the path over the true length, mean over the drives."""
    rows = rows_of("odometry/results/odometry.csv")
    heights = sorted(dict.fromkeys(row["height_m"] for row in rows), key=float)
    bars = {f"height {height} m": {"path": mean(pick(rows, height_m=height), "scale")} for height in heights}
    return "length of the path / true length", bars


def reliability() -> tuple[str, Bars]:
    """Error of packaged steps in the first and in the last chunk of a million."""
    rows = json.loads((STUDIES / "reliability/results/soak.json").read_text())["parts"]["steps"]
    return "mean squared error", {
        row["name"]: {f"{chunk} steps": row[f"mean squared error, {chunk} chunk"] for chunk in ("first", "last")}
        for row in rows
    }


def speed() -> tuple[str, Bars]:
    """Time of a compiled sequence over that of a peer."""
    rows = json.loads((STUDIES / "speed/results/speed.json").read_text())
    bars: Bars = {}
    for row in rows:
        what, _, size = row["name"].removeprefix("compiled ").partition(", B=")
        if row["name"].startswith("compiled") and size and " / " in what and "floor" not in what:
            bars.setdefault(what, {})[f"{size} at a time"] = row["ratio"]
    return "our time / theirs", bars


DRAWN: tuple[Callable[[], tuple[str, Bars]], ...] = (smoothing, fusion, monitor, arms, odometry, reliability, speed)


def draw(label: str, bars: Bars, file: Path) -> None:
    """Draws one group of bars a row, the first on top."""
    series = list(dict.fromkeys(name for values in bars.values() for name in values))
    width = 0.8 / len(series)
    figure, axis = plt.subplots(figsize=(6, 1.2 + 0.18 * len(bars) * (1 + len(series))), layout="constrained")
    for at, name in enumerate(series):
        chosen = [(row, values[name]) for row, values in enumerate(bars.values()) if name in values]
        places, values = zip(*chosen, strict=True)
        drawn = axis.barh([row + (at - (len(series) - 1) / 2) * width for row in places], values, width, label=name)
        axis.bar_label(drawn, fmt="{:.3g}", padding=2, fontsize=8)
    axis.set(yticks=range(len(bars)), yticklabels=bars, xlabel=label)
    axis.invert_yaxis()
    axis.margins(x=0.12)
    axis.spines[["top", "right"]].set_visible(False)
    if len(series) > 1:
        figure.legend(loc="outside upper right", ncols=len(series), fontsize=9, frameon=False)
    save(figure, file)


def main(folder: Path = PAGES) -> None:
    """Draws each picture into a folder."""
    for study in DRAWN:
        draw(*study(), folder / f"{study.__name__}.png")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
