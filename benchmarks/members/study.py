"""The study: its options, its rows, its table and plot."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.plots import plt, save
from benchmarks.common.tables import head, line, pick, records, write_page, write_table
from benchmarks.members import tasks
from benchmarks.members.tasks import Score, Task

PLAIN, BELIEVED = "plain", "significance"
ORDER = ("task", "filter", "members")  # of the rows
TITLES = {"walks": "ten walks", "lorenz96": "Lorenz-96", "ur5": "UR5 arm"}  # others are titled by their name


@dataclass(frozen=True)
class Study:
    """Measures the error of different ensemble sizes, with and without localisation by significance."""

    out: Path | None = None  # folder for members.csv, members.md and members.png; finished rows stay
    runs: Path = Path("runs/members")  # demos of the UR5 and trained motion of the manipulator, made if missing
    members: tuple[int, ...] = (8, 16, 32, 64, 128, 256, 512)
    thresholds: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0)  # candidates, from which validation data choose
    tasks: tuple[str, ...] = ("walks", "reacher", "cartpole", "manipulator", "lorenz96", "wheels", "ur5")
    smoke: bool = False  # two small tasks: do they run?


def made(study: Study, name: str) -> Task:
    """Returns a task with its data."""
    if name == "walks":
        return tasks.walks(*((2, 20) if study.smoke else ()))
    if name == "lorenz96":
        return tasks.lorenz96(*((1, 5) if study.smoke else ()))
    if name == "ur5":
        return tasks.ur5(study.runs / "ur5")
    if name == "manipulator":
        return tasks.manipulator(study.runs / name)
    return {"wheels": tasks.wheels, "reacher": tasks.reacher, "cartpole": tasks.cartpole}[name]()


def rows_of(task: Task, study: Study, there: list[dict]) -> Iterator[dict]:
    """Yields the missing rows of a task."""
    if task.reference is not None:
        name, score = task.reference
        if not pick(there, task=task.name, filter=name):
            yield {"task": task.name, "filter": name, "error": score.error, "held": score.held}
    for members in study.members:
        for kind in (PLAIN, BELIEVED):
            if pick([row for row in there if "members" in row], task=task.name, filter=kind, members=members):
                continue
            began, threshold = time.process_time(), None
            if kind == BELIEVED:
                threshold = chosen(task, study, members)
                if threshold is None:
                    continue
            score = task.score(members, threshold)
            row = {"task": task.name, "filter": kind, "members": members, "error": score.error, "held": score.held}
            yield row | {"threshold": threshold or 0.0, "seconds": time.process_time() - began}


def chosen(task: Task, study: Study, members: int) -> float | None:
    """Returns the threshold with the least error on validation data; ``None`` if there are too few members."""
    able = [threshold for threshold in study.thresholds if threshold**2 < members - 1]
    scores: dict[float, Score] = {threshold: task.validate(members, threshold) for threshold in able}
    return min(scores, key=lambda threshold: scores[threshold].error) if scores else None


def page(rows: list[dict], study: Study) -> str:
    """Returns the table."""
    lines = [
        "# How many members?",
        "",
        'Error, and share of the truth within the 90 % intervals, without and with `localisation="significance"`.',
        "Validation data of the same kind choose the threshold, and of Lorenz-96 the inflation.",
        "",
        *head("task", "error", "members", "without", "coverage", "with", "coverage", "threshold"),
    ]
    for name in tasks.ERRORS:
        own = pick(rows, task=name)
        for row in own:
            if row["filter"] not in (PLAIN, BELIEVED):
                lines.append(line(name, tasks.ERRORS[name], row["filter"], *cells(row), "", "", ""))
        for members in study.members:
            sized = [row for row in own if row.get("members") == members]
            without, believed = ((pick(sized, filter=kind) or [{}])[0] for kind in (PLAIN, BELIEVED))
            if sized:
                threshold = f"{believed['threshold']:g}" if believed else ""
                lines.append(line(name, tasks.ERRORS[name], members, *cells(without), *cells(believed), threshold))
    lines += ["", *made_by("members")]
    return "\n".join(lines) + "\n"


def cells(row: dict) -> tuple[str, str]:
    """Returns error and coverage, empty without a row."""
    return (f"{row['error']:.3g}", f"{row['held']:.0%}") if row else ("", "")


def draw(rows: list[dict], file: Path) -> None:
    """Draws error (left) and coverage (right) against ensemble size, a row for each task."""
    names = [name for name in tasks.ERRORS if pick(rows, task=name)]
    size = (7.5, 1.9 * len(names))
    figure, axes = plt.subplots(len(names), 2, figsize=size, sharex=True, squeeze=False, layout="constrained")
    for name, (left, right) in zip(names, axes, strict=True):
        own = pick(rows, task=name)
        for kind, style, label in ((PLAIN, "o--", "without"), (BELIEVED, "o-", "significance")):
            points = sorted((row for row in own if row["filter"] == kind), key=lambda row: row["members"])
            count = [row["members"] for row in points]
            left.plot(count, [row["error"] for row in points], style, markersize=3, label=label)
            right.plot(count, [100 * row["held"] for row in points], style, markersize=3)
        for row in own:
            if row["filter"] not in (PLAIN, BELIEVED):
                left.axhline(row["error"], color="gray", linewidth=1, label=row["filter"])
        right.axhline(90, color="gray", linewidth=1, linestyle=":")
        left.set(title=TITLES.get(name, name), ylabel=tasks.ERRORS[name], xscale="log")
        if max(row["error"] for row in own) > 5 * min(row["error"] for row in own):
            left.set_yscale("log")
            left.yaxis.set_major_formatter("{x:g}")
            left.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "2346" else "")
        right.set(ylim=(0, 102), ylabel="90 % coverage (%)")
        left.tick_params(axis="y", which="both", labelsize=8)
        left.legend(fontsize=7)
        right.set_xticks([8, 32, 128, 512], ["8", "32", "128", "512"])
        right.minorticks_off()
    for axis in axes[-1]:
        axis.set_xlabel("members")
    save(figure, file)


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, members=(8,), thresholds=(1.0,), tasks=("walks", "lorenz96"))
        study = replace(study, out=Path(tempfile.mkdtemp(prefix="members-")))
    file = None if study.out is None else study.out / "members.csv"
    rows = [] if file is None else records(file)
    for name in study.tasks:
        task = made(study, name)
        for row in rows_of(task, study, rows):
            rows.append(row)
            print(row, flush=True)
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                write_table(rows, file, ORDER)
    write_page(page(rows, study), None if study.out is None else study.out / "members.md")
    if study.out is not None:
        draw(rows, study.out / "members.png")
