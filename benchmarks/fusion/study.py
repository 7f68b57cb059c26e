"""The study: its options, its conditions, its table."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from statistics import median

import torch
from tensordict import TensorDict

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.jobs import compute
from benchmarks.common.tables import head, line, pick, report
from benchmarks.fusion.arm import arm_task
from benchmarks.fusion.car import car_task
from benchmarks.fusion.task import FAULTS, Task, delayed, faulty, without
from benchmarks.fusion.training import make_weights, train
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

ORDER = ("task", "condition", "sensors", "method", "seed")  # of the rows
METHODS = ("plain", "weights")
SECONDS = 3.0  # that a sensor fails
WINDOW, BATCH = 200, 36  # steps of a training window, and windows in an update


@dataclass(frozen=True)
class Study:
    """Fuses several sensors on a UR5 and on KITTI: every subset, and each sensor disturbed and delayed."""

    kitti: Path | None = None  # folder with sequences and poses; without it the car's task is skipped
    out: Path = Path("runs/fusion")
    demos: tuple[int, int] = (24, 6)  # of the UR5, for training and for the test
    seeds: int = 3  # trainings
    validate: bool = False  # score validation recordings instead of the test's
    processes: int = 1
    smoke: bool = False  # tiny tasks: does it run?


def subsets(task: Task) -> list[tuple[str, ...]]:
    """Returns every set of sensors, the smallest first."""
    names = task.sensors
    return [some for count in range(1, len(names) + 1) for some in combinations(names, count)]


@torch.no_grad()
def conditions(task: Task) -> tuple[dict[tuple[str, str], TensorDict], slice]:
    """Returns recordings by sensors and condition, and the steps of the faults."""
    every, count = task.sensors, task.test.shape[1]
    length = min(round(SECONDS * task.rate), count // 2)
    begin = (count - length) // 2
    spans = (torch.full((len(task.test),), begin), torch.full((len(task.test),), begin + length))
    found = {}
    for some in subsets(task):
        lacking = [name for name in every if name not in some]
        found[" + ".join(some), "as it is"] = without(task.test, *lacking)
    for name in every:
        for fault in FAULTS:
            generator = torch.Generator().manual_seed(3)
            found[" + ".join(every), f"{name}: {fault}"] = faulty(task, task.test, name, fault, *spans, generator)
    return found, slice(begin, begin + length)


@torch.no_grad()
def rows(task: Task, weights: torch.nn.Module) -> list[dict]:
    """Returns errors under all conditions; all recordings of all conditions run in one batch."""
    cases, span = conditions(task)
    whole, out = torch.cat(list(cases.values())), []
    for method, network in zip(METHODS, (None, weights), strict=True):
        errors = task.error(run(task.build(network, task.heeds), whole)).split(len(task.test))
        by_case = dict(zip(cases, errors, strict=True))
        for (sensors, condition), error in by_case.items():
            row = {"task": task.name, "method": method, "sensors": sensors, "condition": condition}
            if condition == "as it is":
                out.append({**row, "error": rms(error[:, task.settled])})
                continue
            failed = condition.partition(":")[0]
            others = " + ".join(name for name in task.sensors if name != failed)
            never = rms(by_case[others, "as it is"][:, span])
            out.append({**row, "error": rms(error[:, span]), "error_without": never})
            out[-1]["error_ratio"] = out[-1]["error"] / never
    late = [delayed(task.test, name, task.late[name]) for name in task.sensors]
    for heed in (False, True):
        errors = task.error(run(task.build(None, heed), torch.cat(late))).split(len(task.test))
        for name, data, error in zip(task.sensors, late, errors, strict=True):
            milliseconds = 1e3 * int(data[f"{name}_late"].max()) / task.rate
            text = f"{name}: {milliseconds:.0f} ms late, {'heeded' if heed else 'ignored'}"
            row = {"task": task.name, "method": "plain", "sensors": " + ".join(task.sensors), "condition": text}
            out.append({**row, "error": rms(error[:, task.settled])})
    return out


def run(model, data: TensorDict) -> TensorDict:
    """Returns the filter's means and the truth."""
    return model.sequence(data.copy(), keep=[("belief", "mean")])


def rms(error: torch.Tensor) -> float:
    """Returns the root mean square over all errors and components."""
    return float(error.square().mean().sqrt())


def job(name: str, seed: int, study: Study) -> list[dict]:
    """Returns all rows of one task, trained with one seed."""
    if name == "UR5":
        sizes = {"demos": (2, 2), "steps": 3} if study.smoke else {"demos": study.demos}
        task = arm_task(**sizes, validate=study.validate)
    else:
        task = car_task(study.kitti, frames=6 if study.smoke else 60, validate=study.validate)
    weights, file = make_weights(task, seed), study.out / f"{name}-{seed}.pt"
    if file.exists():
        saved = read_checkpoint(file)
        task.parts.load_state_dict(saved["parts"])
        weights.load_state_dict(saved["weights"])
    else:
        updates, window = ((1, 1), 16) if study.smoke else (task.updates, WINDOW)
        train(task, weights, updates=updates, window=window, batch=BATCH, seed=seed)
        write_checkpoint(file, {"parts": task.parts.state_dict(), "weights": weights.state_dict()})
    return [{**row, "seed": seed} for row in rows(task, weights)]


def page(found: Sequence[dict], study: Study) -> str:
    """Returns the tables of both tasks: medians over the seeds."""

    def middle(rows: Sequence[dict], column: str = "error") -> str:
        return f"{median(row[column] for row in rows):.3g}"

    lines = ["# Several sensors in one filter", "", f"Medians of {study.seeds} trainings.", ""]
    for task, unit in (("UR5", "degrees, six joints"), ("KITTI", "m, each coordinate")):
        own = pick(found, task=task)
        if not own:
            continue
        lines += [f"## {task}: root mean square error, {unit}", "", *head("sensors", *METHODS)]
        subset = pick(own, condition="as it is")
        for sensors in dict.fromkeys(row["sensors"] for row in subset):
            lines.append(line(sensors, *(middle(pick(subset, sensors=sensors, method=method)) for method in METHODS)))
        fails = f"A sensor fails for {SECONDS:g} s, unannounced; the error in that time, compared with the error of the"
        lines += ["", fails]
        lines += ["filter that never had the sensor, in the same time.", ""]
        lines += head("fault", "plain", "weights", "never had it", "plain, times", "weights, times", "worst training")
        failing = [row for row in own if "error_ratio" in row]
        for condition in dict.fromkeys(row["condition"] for row in failing):
            plain, weighed = (pick(failing, condition=condition, method=method) for method in METHODS)
            cells = [middle(plain), middle(weighed), middle(weighed, "error_without")]
            cells += [middle(rows, "error_ratio") for rows in (plain, weighed)]
            lines.append(line(condition, *cells, f"{max(row['error_ratio'] for row in weighed):.3g}"))
        lines += ["", "A sensor comes late:", "", *head("delay", "error")]
        late = dict.fromkeys(row["condition"] for row in own if "late" in row["condition"])
        lines += [line(condition, middle(pick(own, condition=condition))) for condition in late]
        lines.append("")
    return "\n".join([*lines, *made_by("fusion")]) + "\n"


def main() -> None:
    """Runs the study; an interrupted one resumes."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, out=Path(tempfile.mkdtemp(prefix="fusion-")), seeds=1)
    tasks = ["UR5"] + ["KITTI"] * (study.kitti is not None or study.smoke)
    runs = [(name, seed) for seed in range(study.seeds) for name in tasks]
    jobs = {study.out / "parts" / f"{name}-{seed}.json": partial(job, name, seed, study) for name, seed in runs}
    found = compute(jobs, study.processes, "fusion")
    report(study.out, found, page(found, study), "fusion", ORDER)
