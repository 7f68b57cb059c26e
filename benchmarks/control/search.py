"""The search: one learning rate of PPO for each arm of a task, the same rates tried for all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean

from benchmarks.common.arguments import command, parse, processor, some_of
from benchmarks.common.jobs import once, read_rows, side_by_side
from benchmarks.common.tables import Columns, head, line, pick, write_page
from benchmarks.control.page import TITLES, last
from benchmarks.control.run import Budget, cell_name, run
from benchmarks.control.tasks import TASKS

CELLS = {"hike": (0.4, 0.0), "pendulum": (0.2, 0.3)}  # of each task the cell that says most
ARMS = ("LSTM", "GRU", "belief mean", "Kalman", "last reading", "four readings", "truth")
FACTORS, FURTHER = (0.3, 1.0, 3.0), 10.0  # the last one is tried with an arm whose best is the largest before
FIRST = 100  # seed; the study has other ones
COLUMNS = Columns(
    names=("task", "arm", "rate", "seed", "env_steps", "return", "wall_s"),
    text=("task", "arm"),
    whole=("seed", "env_steps"),
    order=lambda row: (list(CELLS).index(row["task"]), ARMS.index(row["arm"]), row["rate"], row["seed"]),
)


@dataclass(frozen=True)
class Search:
    """Learning rates of PPO, tried with each arm on other seeds than the study's. See benchmarks/control/README.md."""

    out: Path = Path("runs/control-search")  # a run that was broken off goes on from here
    tasks: some_of(CELLS) = tuple(CELLS)
    seeds: int = 3  # 0 only makes the table of what is there
    processes: int = 1


def one(task: str, arm: str, rate: float, seed: int) -> list[dict]:
    """The row at the end of a run."""
    rows = last(run(task, CELLS[task], arm, seed, Budget(tests=1, rate=rate)))
    return [{key: rate if key == "rate" else row[key] for key in COLUMNS.names} for row in rows]


def job(search: Search, task: str, arm: str, rate: float, seed: int) -> partial:
    """A run that leaves its row in a file."""
    file = search.out / "parts" / task / f"{arm.replace(' ', '-')}-{rate:g}-{seed}.json"
    return partial(once, file, partial(one, task, arm, rate, seed))


def jobs(search: Search, rows: Sequence[dict] | None = None) -> Iterator[partial]:
    """All runs of the first rates, or those of the further one that the rows of the first ask for."""
    for arm, task in product(ARMS, search.tasks):
        if arm == "Kalman" and TASKS[task].exact is None:
            continue
        if rows is not None and best(rows, task, arm) < max(FACTORS):
            continue
        for seed, rate in product(range(FIRST, FIRST + search.seeds), FACTORS if rows is None else [FURTHER]):
            yield job(search, task, arm, rate, seed)


def found(search: Search) -> list[dict]:
    """The rows of all runs that are there.

    Raises:
        SystemExit: if there is none.
    """
    rows = read_rows(sorted((search.out / "parts").glob("*/*.json")))
    if not rows:
        raise SystemExit(f"{search.out} holds no run.")
    return sorted(rows, key=COLUMNS.order)


def complete(rows: Sequence[dict]) -> list[dict]:
    """The rows of rates that an arm ran at with the same seeds: those with which it ran at all of the first rates."""
    kept = []
    for task, arm in dict.fromkeys((row["task"], row["arm"]) for row in rows):
        own = pick(rows, task=task, arm=arm)
        rates = {*FACTORS, *(row["rate"] for row in own)}
        seeds = {rate: {row["seed"] for row in pick(own, rate=rate)} for rate in rates}
        common = set.intersection(*(seeds[rate] for rate in FACTORS))
        kept += [row for row in own if row["seed"] in common <= seeds[row["rate"]]]
    return kept


def mean(rows: Sequence[dict], task: str, arm: str, rate: float) -> float:
    """The mean return over seeds."""
    return fmean(row["return"] for row in pick(rows, task=task, arm=arm, rate=rate))


def best(rows: Sequence[dict], task: str, arm: str) -> float:
    """The factor with the largest mean return."""
    return max({row["rate"] for row in pick(rows, task=task, arm=arm)}, key=partial(mean, rows, task, arm))


def page(rows: Sequence[dict]) -> str:
    """A table for each task: mean returns over seeds, the best of an arm in bold."""
    what = "Mean return over seeds after all training, the higher the better. Bold: an arm's best, at which it runs."
    lines = ["# PPO's learning rate, for each arm", "", what, ""]
    for task in dict.fromkeys(row["task"] for row in rows):
        factors = sorted({row["rate"] for row in pick(rows, task=task)})
        lines += [
            f"## {TITLES[task]}, {cell_name(CELLS[task])}",
            "",
            *head("arm", "seeds", *(f"rate x {factor:g}" for factor in factors)),
        ]
        for arm in dict.fromkeys(row["arm"] for row in pick(rows, task=task)):
            own = pick(rows, task=task, arm=arm)
            tried, chosen = {row["rate"] for row in own}, best(rows, task, arm)
            cells = [f"{mean(rows, task, arm, factor):.1f}" if factor in tried else "" for factor in factors]
            cells = [f"**{cell}**" if factor == chosen else cell for cell, factor in zip(cells, factors, strict=True)]
            lines.append(line(arm, len({row["seed"] for row in own}), *cells))
        lines.append("")
    return "\n".join([*lines, f"Command: `{command('control.search')}`; one core for each run, {processor()}.", ""])


def main() -> None:
    """Runs the search; one that was broken off goes on."""
    search = parse(Search)
    if search.seeds:
        side_by_side(list(jobs(search)), search.processes, "search")
        side_by_side(list(jobs(search, found(search))), search.processes, "search on")
    rows = complete(found(search))
    if not rows:
        raise SystemExit(f"{search.out} holds no seed with which an arm ran at all of the first rates.")
    COLUMNS.write(rows, search.out / "search.csv")
    write_page(page(rows), search.out / "search.md")


if __name__ == "__main__":
    main()
