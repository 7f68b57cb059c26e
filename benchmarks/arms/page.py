"""The tables of the study, from the rows of its episodes: ``python -m benchmarks.arms.page table.csv``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.arms.arms import ARMS
from benchmarks.common.intervals import bootstrap_interval
from benchmarks.common.tables import Columns, head, line, pick

SOURCES = ("encoders", "pixels")
ESTIMATES = ("reading", "belief", "truth")
SCORES = ("angle", "velocity", "tip", "error", "offset", "return", "effort")
COLUMNS = Columns(
    names=("task", "source", "missing", "estimate", "seed", "episode", *SCORES, "cpu_s"),
    text=("task", "source", "estimate"),
    whole=("seed", "episode"),
    order=lambda row: (
        list(ARMS).index(row["task"]),
        SOURCES.index(row["source"]),
        row["missing"],
        ESTIMATES.index(row["estimate"]),
        row["seed"],
        row["episode"],
    ),
)


def values(rows: Sequence[dict], name: str, **wanted) -> np.ndarray:
    """A score of the episodes of a case, in order; of the truth, which is never missing, those without missing."""
    if wanted.get("estimate") == "truth":
        wanted = {**wanted, "missing": 0.0}
    chosen = sorted(pick(rows, **wanted), key=lambda row: (row["seed"], row["episode"]))
    return np.array([row[name] for row in chosen])


def difference(rows: Sequence[dict], name: str, **case) -> str:
    """Compares the belief's episodes with the readings' of the same starts: mean difference, interval, and share."""
    belief, reading = (values(rows, name, estimate=estimate, **case) for estimate in ("belief", "reading"))
    center, low, high = bootstrap_interval(belief - reading)
    return f"{center:+.2f} [{low:+.2f}, {high:+.2f}], {center / reading.mean():+.0%}"


def page(rows: Sequence[dict]) -> str:
    """The tables of all tasks and sources that there are rows of."""
    cases = [(task, source) for task in ARMS for source in SOURCES if pick(rows, task=task, source=source)]
    shown = dict.fromkeys((row["task"], row["source"], row["missing"]) for row in sorted(rows, key=COLUMNS.order))
    said = "Belief minus readings, in the same episodes: mean, its 95 % interval, and its share of the readings' mean."
    lines = [said, "", *head("task", "missing", "angles, deg", "tip to goal, cm", "velocities, rad/s", "effort")]
    for task, source, missing in shown:
        case = {"task": task, "source": source, "missing": missing}
        names = ("angle", "tip", "velocity", "effort")
        cells = [difference(rows, name, **case) for name in names]
        lines.append(line(f"{task}, {source}", f"{missing:.0%}", *cells))
    for task, source in cases:
        some = pick(rows, task=task, source=source)
        tests = len({(row["seed"], row["episode"]) for row in some})
        seconds = np.mean([row["cpu_s"] for row in some])
        lines += ["", f"## {task.capitalize()}, {source}: {tests} episodes; {seconds:.0f} s of one core", ""]
        titles = ("angles, deg", "velocities, rad/s", "tip to goal, cm", "error of tip, cm", "of it constant, cm")
        lines += head("missing", "policy reads", *titles, "return", "effort")
        for missing in sorted({row["missing"] for row in some}):
            for estimate in ESTIMATES:
                case = {"task": task, "source": source, "missing": missing, "estimate": estimate}
                found = [values(rows, name, **case) for name in SCORES]
                cells = [f"{each.mean():.2f} ± {each.std(ddof=1) / len(each) ** 0.5:.2f}" for each in found]
                lines.append(line(f"{missing:.0%}", estimate, *cells))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(page(COLUMNS.read(Path(sys.argv[1]))))
