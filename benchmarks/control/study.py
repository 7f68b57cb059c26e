"""The study: its options, its cells, its jobs."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pandas as pd

from benchmarks.common.arguments import parse, some_of
from benchmarks.common.jobs import once, read_rows, side_by_side
from benchmarks.common.tables import write_page, write_table
from benchmarks.control.page import draw, page
from benchmarks.control.run import Budget, cell_name, run, shifted_names
from benchmarks.control.tasks import TASKS

SEEING = ("last reading", "four readings", "LSTM")
CELLS = {  # noise of readings, and missing share; the most informative first
    "hike": [(noise, 0.0) for noise in (0.4, 0.0, 0.8, 0.2, 0.1)],
    "pendulum": [(0.2, 0.3), (0.0, 0.0), (0.2, 0.0), (0.2, 0.6), (0.3, 0.0), (0.1, 0.0)],
    "cartpole": [(0.1, 0.0), (0.3, 0.0)],
    "cartpole-full": [(0.1, 0.0)],
}
READERS = {
    "hike": ("Kalman", "belief mean", *SEEING),
    "pendulum": ("belief mean", "belief mean, taught", "belief mean, end to end", *SEEING),
    "cartpole": ("belief mean", "LSTM", "physics"),
    "cartpole-full": ("belief mean", "LSTM", "physics", "last reading"),
}  # in running order; the arm "truth" is added in the cell of the least noise
FEW = ("Kalman", "physics", "belief mean", "LSTM", "last reading", "truth")  # in all cells
MORE_CELLS = 2  # number of a task's first cells in which the other arms run
ONCE = ("belief mean, end to end",)  # slow arms, which run only in the first cell
SEEDS = range(100)  # seeds that the tables read


@dataclass(frozen=True)
class Study:
    """Compares policies on a belief with policies with memory. See benchmarks/control/README.md."""

    out: Path = Path("runs/control")  # an interrupted run resumes from here
    tasks: some_of(CELLS) = tuple(CELLS)
    cells: int = 6  # the first so many of each task
    seeds: int = 5  # 0 only makes the tables of finished runs
    processes: int = 1
    known: Path | None = None  # a control.csv: runs with rows there are not run again
    smoke: bool = False  # a tiny run of a cell of each task: does it run?


def arms_of(task: str, cell: tuple[float, float]) -> tuple[str, ...]:
    """Returns the arms that run in a cell."""
    number = CELLS[task].index(cell)
    arms = (*READERS[task], "truth") if cell == min(CELLS[task]) else READERS[task]
    if number >= MORE_CELLS:
        return tuple(arm for arm in arms if arm in FEW)
    return tuple(arm for arm in arms if number == 0 or arm not in ONCE)


def part(study: Study, task: str, cell: tuple[float, float], arm: str, seed: int) -> Path:
    """Returns the file for the rows of a run."""
    name = arm.replace(", ", "-").replace(" ", "-")
    return study.out / "parts" / task / f"{cell[0]:g}-{cell[1]:g}" / f"{name}-{seed}.json"


def jobs(study: Study, seed: int, budget: Budget) -> Iterator[partial]:
    """Yields all runs with a seed."""
    for task in study.tasks:
        for cell in CELLS[task][: study.cells]:
            for arm in arms_of(task, cell):
                yield partial(once, part(study, task, cell, arm, seed), partial(run, task, cell, arm, seed, budget))


def keep(study: Study, table: Path) -> None:
    """Writes the rows of a table to the files of their runs, without overwriting finished runs."""
    rows = pd.read_csv(table)
    trained = {
        (task, name): cell
        for task, cells in CELLS.items()
        for cell in cells
        for name in (cell_name(cell), *shifted_names(TASKS[task], cell))
    }
    cells = rows[["task", "cell"]].apply(lambda row: trained[tuple(row)], axis=1)
    for (task, cell, arm, seed), found in rows.groupby([rows["task"], cells, rows["arm"], rows["seed"]]):
        once(part(study, task, cell, arm, seed), partial(found.to_dict, "records"))


def complete(study: Study) -> list[dict]:
    """Returns the rows of seeds with which all arms of a cell have run; prints the missing arms of others."""
    files: list[Path] = []
    for task in study.tasks:
        for cell in CELLS[task]:
            for seed in SEEDS:
                found = {arm: part(study, task, cell, arm, seed) for arm in arms_of(task, cell)}
                absent = [arm for arm, file in found.items() if not file.exists()]
                files += [] if absent else found.values()
                if 0 < len(absent) < len(found):
                    where = f"{task}, {cell_name(cell)}, seed {seed}"
                    print(f"Left out of the tables: {where}. Not run: {', '.join(absent)}.")
    return read_rows(files)


def main() -> None:
    """Runs the study; an interrupted one resumes."""
    study, budget = parse(Study), Budget()
    if study.smoke:
        study = replace(study, out=Path(tempfile.mkdtemp(prefix="control-")), seeds=1, cells=1)
        budget = Budget(env_steps=2 * 16 * 200, tests=1, episodes=2, members=4, updates=0.02, every=200)
        for task in ("hike", "pendulum"):
            CELLS[task], READERS[task] = [(0.0, 0.0)], ("four readings", "LSTM", "belief mean")
        READERS["cartpole"] = ("four readings", "LSTM", "belief mean", "physics")
        READERS["cartpole-full"] = ("last reading", "belief mean")
    if study.known is not None:
        keep(study, study.known)
    todo = [job for seed in range(study.seeds) for job in jobs(study, seed, budget)]
    side_by_side(todo, study.processes, "runs")
    rows = complete(study)
    if not rows:
        raise SystemExit(f"{study.out} has no cell in which all arms have run.")
    table = write_table(rows, study.out / "control.csv", ("task", "cell", "arm", "seed", "env_steps"))
    draw(table, study.out / "control.png")
    write_page(page(table, budget), study.out / "control.md")
    if study.smoke:
        print("A smoke run: it ran, and its figures say nothing.")
