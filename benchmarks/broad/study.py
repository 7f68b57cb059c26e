"""The study: its options, its rows, its tables."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from benchmarks.broad.task import Trial, read_trials, scores, simulated_trial
from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import Columns, head, line, report
from torch_denkf.applications.imu.filter import ImuFilter, ImuSettings
from torch_denkf.applications.imu.log import Orientations, at_readings, imu_rows
from torch_denkf.functional.manifolds import SO3

NUMBERS = Path(__file__).parent / "numbers.json"
HELD = ["heading_held", "inclination_held"]
SCORES = ("total", "heading", "inclination", *HELD, "heading_std")
COLUMNS = Columns(
    names=("trial", "kind", "method", "numbers", *SCORES),
    text=("trial", "kind", "method", "numbers"),
    whole=(),
    order=lambda row: (row["trial"], METHODS.index(row["method"])),
)
OWN, SIX, VQF, VQF_SIX = "imu", "imu, 6 axes", "VQF", "VQF, 6 axes"
MOVED = ", latency removed"  # moved on by the learned latency; all others are as stamped
METHODS = [name + moved for moved in ("", MOVED) for name in (OWN, VQF, SIX, VQF_SIX)]
TOGETHER = 6  # trials in a batch: about 5 GB


@dataclass(frozen=True)
class Study:
    """Compares orientation filters on the trials of BROAD."""

    data: Path = Path("../shared/data/broad")  # folder with .npz files of BROAD
    out: Path | None = None  # folder for broad.csv and broad.md
    smoke: bool = False  # ten simulated seconds: does it run?


@torch.no_grad()
def run(settings: ImuSettings, trials: Sequence[Trial]) -> list[dict[str, Orientations]]:
    """Returns the filter's orientations with 9 and with 6 axes, for each trial: all run in one batch."""
    both = []
    for trial in trials:
        both.append(imu_rows(settings, trial.gyro, trial.acceleration, trial.magnetometer, rate=trial.rate))
        both.append(imu_rows(settings, trial.gyro, trial.acceleration, rate=trial.rate))
    longest = max(map(len, both))  # shorter ones repeat their last row
    batch = torch.stack([rows[torch.arange(longest).clamp_max(len(rows) - 1)] for rows in both])
    belief = ImuFilter(settings).double().sequence(batch, keep=[("belief", "mean"), ("belief", "cov")])["belief"]
    found: list[dict[str, Orientations]] = [{} for _ in trials]
    for place, rows in enumerate(both):
        trial, own = trials[place // 2], belief[place, : len(rows)]
        way = SIX if place % 2 else OWN
        found[place // 2][way] = at_readings(settings, own["mean"], own["cov"], trial.gyro, trial.rate)
    return found


def vqf(trial: Trial) -> tuple[Tensor, Tensor]:
    """Returns orientations of VQF with its default settings, with 9 and with 6 axes."""
    from vqf import VQF

    sensors = (trial.gyro, trial.acceleration, trial.magnetometer)
    out = VQF(1 / trial.rate).updateBatch(*(value.numpy().copy() for value in sensors))
    return torch.as_tensor(out["quat9D"]), torch.as_tensor(out["quat6D"])


def settings_for(kind: str, numbers: dict[str, dict]) -> tuple[str, ImuSettings]:
    """Returns the numbers that were learned without a kind of motion; those of all for a kind that was not there."""
    name = kind if kind in numbers else "all"
    return name, ImuSettings(**numbers[name])


def rows_of(trial: Trial, own: dict[str, Orientations], numbers: str, settings: ImuSettings) -> Iterator[dict]:
    """Yields the rows of all methods on one trial.

    Args:
        trial: with readings and truth.
        own: the filter's orientations by method, moved on by the latency.
        numbers: name of their numbers.
        settings: of the filter.
    """

    def scored(method: str, quaternion: Tensor, std: Tensor | None = None, by: float = 0.0) -> dict:
        told = {"trial": trial.name, "kind": trial.kind, "method": method, "numbers": numbers}
        return {**told, **scores(trial, SO3().plus(quaternion, trial.gyro * by) if by else quaternion, std)}

    for method, found in own.items():
        yield scored(method + MOVED, found.quaternion, found.std)
        yield scored(method, found.quaternion, found.std, by=-settings.latency)
    if find_spec("vqf"):
        for method, quaternion in zip((VQF, VQF_SIX), vqf(trial), strict=True):
            yield scored(method, quaternion)
            yield scored(method + MOVED, quaternion, by=settings.latency)


def page(rows: Sequence[dict], smoke: bool = False) -> str:
    """Returns the tables, in Markdown."""
    table = pd.DataFrame(rows, columns=COLUMNS.names)
    methods = [method for method in METHODS if method in set(table["method"])]
    north = [method for method in methods if "6 axes" not in method]
    table["disturbed"] = table["trial"].str.contains("_disturbed")
    means, worst = table.groupby("method")[["total", "heading", "inclination"]].mean(), table.groupby("method").max()
    count = table["trial"].nunique()
    text = [f"# Orientation on BROAD\n\nMean over {count} trials, root mean square errors in degrees.\n"]
    text += head("method", "total", "heading", "inclination", "worst total")
    for method in methods:
        cells = [f"{error:.2f}" for error in (*means.loc[method], worst["total"][method])]
        text.append(line(method, *(cells if method in north else ["", "", cells[2], ""])))
    text += ["", "Coverage of the 90 % intervals, %, averaged over trials; heading and inclination.", ""]
    text += head("method", "all trials", "undisturbed", "disturbed")
    for method in methods:
        own = table[table["method"] == method]
        parts = own, own[~own["disturbed"]], own[own["disturbed"]]
        if own[HELD].notna().all(axis=None):
            text.append(line(method, *(coverage(part, HELD if method in north else HELD[1:]) for part in parts)))
    told = "Total error of each trial, degrees, and coverage (heading / inclination) of the intervals of "
    text += ["", f"{told}{OWN}{MOVED}, %.", "", *head("trial", *north, "coverage")]
    for name, errors in table.pivot(index="trial", columns="method", values="total")[north].iterrows():
        own = table[(table["trial"] == name) & (table["method"] == OWN + MOVED)]
        text.append(line(name, *errors.map("{:.2f}".format), coverage(own, HELD)))
    text += ["", "Inclination of each trial, degrees.", "", *head("trial", *methods)]
    for name, errors in table.pivot(index="trial", columns="method", values="inclination")[methods].iterrows():
        text.append(line(name, *errors.map("{:.2f}".format)))
    data = "simulated" if smoke else "Laidig et al. 2021, CC BY 4.0"
    text += ["", *made_by("broad"), f"* Data: {data}. Numbers: `numbers.json`, see the README.", ""]
    return "\n".join(text)


def coverage(rows: pd.DataFrame, columns: list[str]) -> str:
    """Returns the mean coverage of rows, in percent."""
    return " / ".join(f"{100 * share:.0f}" for share in rows[columns].mean()) if len(rows) else ""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the study."""
    study = parse(Study, arguments)
    if not find_spec("vqf"):
        print('VQF is left out: pip install vqf, or "torch_denkf[bench]"')
    numbers = json.loads(NUMBERS.read_text())["numbers"]
    trials = [simulated_trial()] if study.smoke else read_trials(study.data)
    groups: dict[ImuSettings, list[tuple[Trial, str]]] = {}
    for trial in trials:
        name, settings = settings_for(trial.kind, numbers)
        groups.setdefault(settings, []).append((trial, f"without {name}" if name == trial.kind else name))
    rows: list[dict] = []
    for settings, group in groups.items():
        for some in [group[first : first + TOGETHER] for first in range(0, len(group), TOGETHER)]:
            for (trial, name), own in zip(some, run(settings, [trial for trial, _ in some]), strict=True):
                for row in rows_of(trial, own, name, settings):
                    rows.append(row)
                    found = {score: round(row[score], 2) for score in SCORES if score in row}
                    print(trial.name, row["method"], found, flush=True)
    rows.sort(key=COLUMNS.order)
    report(study.out, COLUMNS, rows, page(rows, study.smoke), "broad")
