"""Tables and plot of the study: interquartile means over seeds, with bootstrap intervals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy.stats import trim_mean

from benchmarks.common.arguments import command, processor
from benchmarks.common.intervals import bootstrap_interval
from benchmarks.common.plots import plt, save
from benchmarks.common.tables import markdown
from benchmarks.control.arms import ARMS
from benchmarks.control.run import NOT_TRAINED, Budget

TITLES = {
    "hike": "Mountain hike",
    "pendulum": "Pendulum without velocity",
    "cartpole": "Cartpole swing-up without velocities",
    "cartpole-full": "Cartpole swing-up, velocities read too",
}
KNOWING = ("truth", "Kalman", "physics")  # arms with the true state or the true model


def interquartile_mean(values, axis: int = -1):
    """Returns the mean of the middle half."""
    return trim_mean(values, 0.25, axis=axis)


def summary(values: pd.Series) -> str:
    """Returns the interquartile mean over seeds and its 95 % bootstrap interval; empty for cells that did not run."""
    values = values.dropna()
    if values.empty:
        return ""
    center, low, high = bootstrap_interval(values.to_numpy(), interquartile_mean)
    return f"{center:z.1f}" if np.isnan(low) else f"{center:z.1f} [{low:z.1f}, {high:z.1f}]"


def is_trained(frame: pd.DataFrame) -> pd.Series:
    """Marks rows of cells in which policies were trained."""
    return ~frame.index.get_level_values("cell").str.contains(NOT_TRAINED)


def ends(rows: pd.DataFrame) -> pd.DataFrame:
    """Returns the final returns of a task by cell and seed, with a column for each arm.

    The arm that reads the truth ran in one cell alone; its return is copied to all cells with training.
    """
    final = rows.loc[rows.groupby(["cell", "arm", "seed"])["env_steps"].idxmax()]
    wide = final.pivot(index=["cell", "seed"], columns="arm", values="return")
    wide = wide[[arm for arm in ARMS if arm in wide]]
    if "truth" in wide:
        once = wide.loc[is_trained(wide), "truth"].dropna().droplevel("cell")
        same = pd.Series(wide.index.get_level_values("seed").map(once), wide.index)
        wide["truth"] = wide["truth"].where(wide["truth"].notna() | ~is_trained(wide), same)
    return wide


def by_cell(wide: pd.DataFrame) -> list[str]:
    """Returns a table of interquartile means over seeds, of each cell and arm."""
    return markdown(wide.groupby("cell").agg(summary))


def lost(wide: pd.DataFrame) -> pd.DataFrame:
    """Returns the loss in other cells, in percent of the return in the first cell with the same seed."""
    home = wide.index.get_level_values("cell")[0]
    shares = 100 * (1 - wide.div(wide.loc[home], level="seed"))
    return shares.drop(home, level="cell")


def reached(rows: pd.DataFrame) -> pd.DataFrame:
    """Returns the first environment steps, in thousands, whose interquartile mean reaches the LSTM's final one."""
    means = rows.groupby(["cell", "arm", "env_steps"])["return"].agg(interquartile_mean).unstack("arm")
    goal = means["LSTM"].groupby("cell").last()

    def first(arm: pd.Series) -> pd.Series:
        found = arm[arm.ge(goal, level="cell")].reset_index("env_steps")["env_steps"].groupby("cell").min()
        ran = arm.groupby("cell").any()
        return found.reindex(goal.index).map("{:.0f}".format, na_action="ignore").fillna("never").where(ran, "")

    return means.rename_axis(columns=None).apply(lambda arm: first(arm / 1.0))


def page(rows: pd.DataFrame, budget: Budget) -> str:
    """Returns the tables of runs with a budget."""
    lines = ["# Policies that read a belief, against policies that remember", ""]
    for task in [task for task in TITLES if task in set(rows["task"])]:
        own = rows[rows["task"] == task]
        wide, trained = ends(own), own[~own["cell"].str.contains(NOT_TRAINED)]
        inside = wide[is_trained(wide)]
        what = "Return of a test episode, the higher the better: interquartile mean over seeds, 95 % interval"
        lines += [f"## {TITLES[task]}", "", f"{what}. Seeds: {own['seed'].nunique()}.", "", *by_cell(wide)]
        if len(inside) < len(wide):
            home = wide.index.get_level_values("cell")[0]
            title = f"Percent of the return with {home} that is lost, with the same seeds. A negative loss is a gain."
            lines += ["", title, "", *by_cell(lost(wide))]
        others = [arm for arm in ("LSTM", "Kalman", "physics") if arm in wide]
        if "belief mean" in wide:
            ahead = inside[others].rsub(inside["belief mean"], axis=0)
            lines += ["", "How much more the belief's mean returns than another arm with the same seed.", ""]
            lines += by_cell(ahead)
        if "LSTM" in wide:
            steps = "Thousands of environment steps until the interquartile mean is the LSTM's final one."
            curves = trained[trained["arm"] != "truth"].assign(env_steps=trained["env_steps"] / 1000)
            lines += ["", steps, "", *markdown(reached(curves)[[arm for arm in wide if arm != "truth"]])]
        seconds = trained.groupby(["cell", "arm", "seed"])["wall_s"].max().groupby("arm").median()
        seconds = seconds[list(wide.columns)].map("{:.0f}".format).rename("seconds of one core for a run")
        lines += ["", *markdown(seconds.to_frame()), ""]
    lines += [
        f"Each test is of {budget.episodes} episodes, in which a policy takes the mean of its actions. What reads the",
        "truth is the same in all cells of a task, and runs in the one with the least noise.",
        "",
        "![Return against the noise of the readings](control.png)",
        "",
        f"* Command: `{command('control')}`. A seed counts where all arms of a cell have run with it.",
        f"* Hardware: {processor()}; torch {torch.__version__}.",
    ]
    return "\n".join(lines) + "\n"


def draw(rows: pd.DataFrame, file: Path) -> None:
    """Draws return against noise in cells without missing readings, for tasks with two noises or more."""
    whole = rows[~rows["cell"].str.contains(f"missing|{NOT_TRAINED}")]
    tasks = [task for task in TITLES if whole.loc[whole["task"] == task, "cell"].nunique() > 1]
    if not tasks:
        return
    figure, axes = plt.subplots(1, len(tasks), figsize=(3.4 * len(tasks), 3.4), squeeze=False, layout="constrained")
    for axis, task in zip(axes[0], tasks, strict=True):
        wide = ends(whole[whole["task"] == task])
        for arm, returns in wide.dropna(axis=1).items():
            found = {
                float(cell.split()[1]): bootstrap_interval(own.to_numpy(), interquartile_mean)
                for cell, own in returns.groupby("cell")
            }
            noise, (center, low, high) = sorted(found), np.array([found[key] for key in sorted(found)]).T
            color = f"C{list(ARMS).index('Kalman' if arm == 'physics' else arm)}"  # no task has both
            axis.plot(noise, center, "--" if arm in KNOWING else "-", marker="o", markersize=3, color=color, label=arm)
            axis.fill_between(noise, low, high, color=color, alpha=0.12, linewidth=0)
        axis.set(xlabel="standard deviation of a reading", ylabel="return of an episode")
        axis.set_title(TITLES[task], fontsize=10)
        axis.legend(fontsize=7)
    save(figure, file)
