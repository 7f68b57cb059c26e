"""Tables and picture of the study: interquartile means over seeds, with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.stats import trim_mean

from benchmarks.common.arguments import command, processor
from benchmarks.common.intervals import bootstrap_interval
from benchmarks.common.plots import plt, save
from benchmarks.common.tables import Columns, head, line, pick
from benchmarks.control.arms import ARMS
from benchmarks.control.run import Budget
from benchmarks.control.shift import NOT_TRAINED
from benchmarks.control.tasks import TASKS

TITLES = {
    "hike": "Mountain hike",
    "pendulum": "Pendulum without velocity",
    "cartpole": "Cartpole swing-up without velocities",
    "cartpole-full": "Cartpole swing-up, velocities read too",
}
PLANNED = Budget()
COLUMNS = Columns(
    names=("task", "cell", "arm", "seed", "env_steps", "return", "wall_s"),
    text=("task", "cell", "arm"),
    whole=("seed", "env_steps"),
    order=lambda row: (
        list(TITLES).index(row["task"]),
        row["cell"],
        list(ARMS).index(row["arm"]),
        row["seed"],
        row["env_steps"],
    ),
)


def interquartile_mean(values: Sequence[float], axis: int = -1):
    """The mean of the middle half."""
    return trim_mean(values, 0.25, axis=axis)


def summary(values: Sequence[float]) -> tuple[float, float, float]:
    """The interquartile mean, and the bounds of its 95 % percentile bootstrap interval over seeds."""
    return bootstrap_interval(values, interquartile_mean)


def last(rows: Sequence[dict]) -> list[dict]:
    """The rows at the end of their runs."""
    most = max((row["env_steps"] for row in rows), default=0)
    return [row for row in rows if row["env_steps"] == most]


def returns(rows: Sequence[dict], task: str, cell: str, arm: str) -> list[float]:
    """The final returns; of what reads the truth those of another cell where it ran in that one alone."""
    return list(_ends(rows, task, cell, arm).values())


def _ends(rows: Sequence[dict], task: str, cell: str, arm: str) -> dict[int, float]:
    """The final returns of :func:`returns`, by seed."""
    chosen = pick(rows, task=task, cell=cell, arm=arm)
    if arm == "truth" and not chosen and NOT_TRAINED not in cell:
        chosen = [row for row in pick(rows, task=task, arm=arm) if NOT_TRAINED not in row["cell"]]
    return {row["seed"]: row["return"] for row in last(chosen)}


def ahead(rows: Sequence[dict], task: str, cell: str, arm: str, other: str) -> list[float]:
    """How much more an arm returns than another, with each seed that both have."""
    own, others = (_ends(rows, task, cell, name) for name in (arm, other))
    return [value - others[seed] for seed, value in own.items() if seed in others]


def cells(rows: Sequence[dict], task: str, trained: bool = False) -> list[str]:
    """Names of a task's cells, in order: all, or those that were trained in."""
    names = dict.fromkeys(row["cell"] for row in pick(rows, task=task))
    return [name for name in names if not (trained and NOT_TRAINED in name)]


def arms(rows: Sequence[dict], task: str) -> list[str]:
    """Names of a task's arms, in order."""
    present = {row["arm"] for row in pick(rows, task=task)}
    return [arm for arm in ARMS if arm in present]


def reached(rows: Sequence[dict], task: str, cell: str, arm: str) -> str:
    """Environment steps after which the interquartile mean first is the LSTM's final one, in thousands."""
    goal = float(interquartile_mean(returns(rows, task, cell, "LSTM")))
    chosen = pick(rows, task=task, cell=cell, arm=arm)
    if not chosen:
        return ""
    for steps in sorted({row["env_steps"] for row in chosen}):
        if interquartile_mean([row["return"] for row in chosen if row["env_steps"] == steps]) >= goal:
            return f"{steps / 1000:.0f}"
    return "never"


def tested(rows: Sequence[dict], task: str) -> list[set[int]]:
    """For each run of a task, the environment steps after which it was tested."""
    runs: dict[tuple, set[int]] = {}
    for row in pick(rows, task=task):
        if NOT_TRAINED not in row["cell"]:
            runs.setdefault((row["cell"], row["arm"], row["seed"]), set()).add(row["env_steps"])
    return list(runs.values())


def whole(rows: Sequence[dict], task: str) -> bool:
    """Whether all runs of a task had the budget that the study gives them."""
    batch = TASKS[task].count * TASKS[task].steps
    end = TASKS[task].env_steps // batch * batch
    return all(max(steps) == end and len(steps) == PLANNED.tests for steps in tested(rows, task))


def page(rows: Sequence[dict], budget: Budget = PLANNED) -> str:
    """The tables; ``budget`` is the runs'."""
    drawn = any(len(noises(rows, task)) > 1 for task in TITLES)
    lines = ["# Policies that read a belief, against policies that remember", ""]
    for task, title in TITLES.items():
        names = arms(rows, task)
        if not names:
            continue
        what = "Return of a test episode, the higher the better: interquartile mean over seeds, 95 % interval"
        lines += [f"## {title}", "", f"{what}; (n): n seeds.", "", *head("cell", "seeds", *names)]
        for cell in cells(rows, task):
            found = [returns(rows, task, cell, arm) for arm in names]
            seeds = {row["seed"] for row in pick(rows, task=task, cell=cell)}  # what reads the truth may have more
            lines.append(line(cell, len(seeds), *(_text(each, len(seeds)) for each in found)))
        lines += lost(rows, task)
        others = [arm for arm in ("LSTM", "GRU", "Kalman", "physics") if arm in names]
        lines += ["", "How much more the belief's mean returns than another arm with the same seed.", ""]
        lines += head("cell", *others)
        for cell in cells(rows, task, trained=True):
            lines.append(line(cell, *(_text(ahead(rows, task, cell, "belief mean", other)) for other in others)))
        steps = "Thousands of environment steps until the interquartile mean is the LSTM's final one; fewer is better"
        counts = {len(tests) for tests in tested(rows, task)}
        some = f"; a run has {max(counts)} test{'s' * (max(counts) > 1)}" if len(counts) == 1 else ""
        lines += ["", f"{steps}{some}.", ""]
        learning = [arm for arm in names if arm != "truth"]
        lines += head("cell", *learning)
        for cell in cells(rows, task, trained=True):
            lines.append(line(cell, *(reached(rows, task, cell, arm) for arm in learning)))
        lines += ["", "Seconds of one core for a run, median over cells and seeds.", "", *head(*names)]
        trained = [row for row in rows if NOT_TRAINED not in row["cell"]]
        ends = [last(pick(trained, task=task, arm=arm)) for arm in names]
        lines += [line(*(f"{np.median([row['wall_s'] for row in end]):.0f}" for end in ends)), ""]
    planned = budget == PLANNED and all(whole(rows, task) for task in {row["task"] for row in rows})
    size = f"Each test is of {budget.episodes} episodes, in which" if planned or budget != PLANNED else "In a test"
    made = f"`{command('control')}`; the runs had another budget than the study's."
    made = "`python -m benchmarks.control`." if planned else made
    lines += [
        f"{size} a policy takes the mean of its actions. What reads the truth is the",
        "same in all cells of a task, and runs in the one with the least noise.",
        "",
        *(["![Return against the noise of the readings](control.png)", ""] if drawn else []),
        f"* Command: {made} A seed counts where all arms of a cell have run with it.",
        f"* Hardware: {processor()}; torch {torch.__version__}.",
    ]
    return "\n".join(lines) + "\n"


def lost(rows: Sequence[dict], task: str) -> list[str]:
    """The table of what arms lose where readings are noisier, in training too or after it; none without the latter."""
    names, (home, *away) = arms(rows, task), cells(rows, task)
    if not any(NOT_TRAINED in cell for cell in away):
        return []
    title = f"Percent of the return with {home} that is lost, with the same seeds. A negative loss is a gain."
    lines = ["", title, "", *head("cell", *names)]
    for cell in away:
        shares = []
        for arm in names:
            before, after = (_ends(rows, task, one, arm) for one in (home, cell))
            shares.append([100 * (1 - value / before[seed]) for seed, value in after.items() if seed in before])
        lines.append(line(cell, *map(_text, shares)))
    return lines


def _text(values: Sequence[float], seeds: int = 0) -> str:
    """Mean and interval; with the number of values where there are fewer than ``seeds``."""
    if not len(values):
        return ""
    center, low, high = summary(values)
    text = f"{center:z.1f}" if np.isnan(low) else f"{center:z.1f} [{low:z.1f}, {high:z.1f}]"
    return f"{text} ({len(values)})" if len(values) < seeds else text


def noises(rows: Sequence[dict], task: str) -> dict[str, float]:
    """Noises of a task's cells in which all readings come."""
    return {cell: float(cell.split()[1]) for cell in cells(rows, task, trained=True) if "missing" not in cell}


def draw(rows: Sequence[dict], file: Path) -> None:
    """Return against the noise of the readings, where all come: of arms that ran with each noise, if there are two."""
    tasks = [task for task in TITLES if len(noises(rows, task)) > 1]
    if not tasks:
        return
    figure, axes = plt.subplots(1, len(tasks), figsize=(3.4 * len(tasks), 3.4), squeeze=False, layout="constrained")
    for axis, task in zip(axes[0], tasks, strict=True):
        for arm in arms(rows, task):
            chosen = [(noise, returns(rows, task, cell, arm)) for cell, noise in noises(rows, task).items()]
            if not all(found for _, found in chosen):
                continue
            points = sorted((noise, *summary(found)) for noise, found in chosen)
            noise, center, low, high = np.array(points).T
            color = f"C{list(ARMS).index('Kalman' if arm == 'physics' else arm)}"  # no task has both
            style = "--" if arm in ("truth", "Kalman", "physics") else "-"
            axis.plot(noise, center, style, marker="o", markersize=3, color=color, label=arm)
            axis.fill_between(noise, low, high, color=color, alpha=0.12, linewidth=0)
        axis.set(xlabel="standard deviation of a reading", ylabel="return of an episode")
        axis.set_title(TITLES[task], fontsize=10)
        axis.legend(fontsize=7)
    save(figure, file)
