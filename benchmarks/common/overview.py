"""Draws bar charts for the pages of results from the studies' rows: ``python -m benchmarks.common.overview``."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from benchmarks.common.plots import plt, save

ENDS = ("first", "last")
STUDIES = Path(__file__).parents[1]
PAGES = STUDIES.parent / "docs" / "results"
Bars = tuple[str, pd.DataFrame]  # the axis' label; a column for each series, a row for each group of bars


def smoothing() -> Bars:
    """Returns the error of filter and smoother on chaotic systems, without methods that have no smoother."""
    rows = pd.read_csv(STUDIES / "smoothing/results/smoothing.csv").dropna(subset="rmse_smoother")
    lags = rows["lag"].map(", lag {:.0f}".format, na_action="ignore").fillna("")
    names = rows["system"] + ", " + rows["method"] + lags
    bars = rows.groupby(names, sort=False)[["rmse_filter", "rmse_smoother"]].mean()
    return "root mean square error", bars.set_axis(["filter", "smoother"], axis=1)


def fusion() -> Bars:
    """Returns the error on KITTI while a sensor fails, median over the trainings."""
    rows = pd.read_csv(STUDIES / "fusion/results/fusion.csv").query("task == 'KITTI'").dropna(subset="error_without")
    medians = rows.pivot_table(["error", "error_without"], "condition", "method", "median", sort=False)
    bars = {"plain": medians["error", "plain"], "weights": medians["error", "weights"]}
    without = medians["error_without", "weights"]
    return "car: error while a sensor fails, m", pd.DataFrame({**bars, "without that sensor": without})


def monitor() -> Bars:
    """Returns the end-point error, with and without the monitor's response."""
    rows = pd.read_csv(STUDIES / "monitor/results/monitor.csv").dropna(subset="m_per_m")
    faults = rows["fault"].map({"none": "no fault", "black-all": "30 % black", "box-all": "a box"})
    names = rows["task"].str.removeprefix("kitti-") + ": " + faults
    bars = rows.set_index(names)[["m_per_m", "m_per_m_gated"]].set_axis(["alone", "with an answer"], axis=1)
    return "car: error of the path's end, m/m", bars


def arms() -> Bars:
    """Returns the mean distance of an arm's tip from its goal."""
    rows = pd.read_csv(STUDIES / "arms/results/table.csv")
    missing = rows["missing"].map(lambda share: f", {share:.0%} missing" if share else "")
    tips = rows.groupby([rows["task"] + ", " + rows["source"] + missing, "estimate"], sort=False)["tip"].mean()
    return "tip to goal, cm", tips.unstack("estimate", sort=False)[["reading", "belief"]]


def odometry() -> Bars:
    """Returns the estimated over the true path length, mean over the drives."""
    scales = pd.read_csv(STUDIES / "odometry/results/odometry.csv").groupby("height_m")["scale"].mean()
    return "length of the path / true length", scales.rename(index="height {:g} m".format).to_frame("path")


def reliability() -> Bars:
    """Returns the error of packaged steps in the first and in the last chunk of a million."""
    rows = json.loads((STUDIES / "reliability/results/soak.json").read_text())["parts"]["steps"]
    bars = {f"{at} steps": {row["name"]: row[f"mean squared error, {at} chunk"] for row in rows} for at in ENDS}
    return "mean squared error", pd.DataFrame(bars)


def speed() -> Bars:
    """Returns the time of a compiled sequence divided by that of a peer."""
    rows = pd.DataFrame(json.loads((STUDIES / "speed/results/speed.json").read_text()))
    found = rows["name"].str.extract(r"^compiled (?P<what>.+ / .+), B=(?P<size>.+)$").join(rows["ratio"]).dropna()
    bars = found.pivot(index="what", columns="size", values="ratio").loc[found["what"].unique(), found["size"].unique()]
    return "our time / theirs", bars.add_suffix(" at a time")


DRAWN: tuple[Callable[[], Bars], ...] = (smoothing, fusion, monitor, arms, odometry, reliability, speed)


def draw(label: str, bars: pd.DataFrame, file: Path) -> None:
    """Draws one group of bars a row, the first on top."""
    figure, axis = plt.subplots(figsize=(6, 1.2 + 0.18 * len(bars) * (1 + bars.shape[1])), layout="constrained")
    bars.plot.barh(ax=axis, width=0.8, legend=False, xlabel=label, ylabel="")
    for drawn in axis.containers:
        axis.bar_label(drawn, fmt="{:.3g}", padding=2, fontsize=8)
    axis.invert_yaxis()
    axis.margins(x=0.12)
    axis.spines[["top", "right"]].set_visible(False)
    if bars.shape[1] > 1:
        figure.legend(loc="outside upper right", ncols=bars.shape[1], fontsize=9, frameon=False)
    save(figure, file)


def main(folder: Path = PAGES) -> None:
    """Draws each chart into a folder."""
    for study in DRAWN:
        draw(*study(), folder / f"{study.__name__}.png")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
