"""The study: its options, its rows, its tables."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from benchmarks.broad.learning import Equations, beliefs
from benchmarks.broad.peers import GAINS, PACKAGES, gradient_filter, has, vqf
from benchmarks.broad.pictures import draw
from benchmarks.broad.task import Trial, first_orientation, read_trials, scores, simulated_trial
from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, pick, write_page, write_table
from torch_denkf.applications.imu.filter import ImuFilter, ImuSettings
from torch_denkf.applications.imu.log import Orientations, at_readings, imu_rows
from torch_denkf.deployment.files import write_text
from torch_denkf.functional.manifolds import SO3
from torch_denkf.smoothers import RTSSmoother

NUMBERS = Path(__file__).parent / "numbers.json"
HELD = ("heading", "inclination")
SCORES = ("total", "heading", "inclination", "heading_held", "inclination_held", "heading_std")
OWN, SMOOTH, SIX, VQF, VQF_SIX = "imu", "smoother (RTS) of imu", "imu, 6 axes", "VQF", "VQF, 6 axes"
MOVED = ", latency removed"  # extrapolated by the learned latency; all others are as stamped
METHODS = (
    *(name + moved for moved in ("", MOVED) for name in (OWN, VQF, SIX, VQF_SIX)),
    *(SMOOTH + MOVED, "Madgwick", "Mahony", "gyro alone"),
)
TOGETHER = 6  # trials in a batch: about 5 GB


@dataclass(frozen=True)
class Study:
    """Compares orientation filters on the trials of BROAD."""

    data: Path = Path("../shared/data/broad")  # folder with .npz files of BROAD
    out: Path | None = None  # folder for broad.csv, broad.json, broad.md and broad.png
    smoother: bool = True  # run the smoother, too
    equations: bool = False  # the filter by equations.c instead, without smoother; needs the C compiler cc
    smoke: bool = False  # ten simulated seconds: does it run?


class Runner:
    """Runs the filter, 9 and 6 axes, and the smoother on a batch of trials with the same parameters.

    Args:
        smoother: whether the smoother runs, too.
        equations: whether the equations in C run instead of the library.
    """

    def __init__(self, smoother: bool = True, equations: bool = False):
        self.smoother, self.equations = smoother and not equations, Equations() if equations else None

    @torch.no_grad()
    def __call__(self, settings: ImuSettings, trials: Sequence[Trial]) -> list[dict[str, Orientations]]:
        """Returns orientations by method, for each trial."""
        if self.equations is not None:
            found = []
            for trial in trials:
                runs = {way: beliefs(self.equations, trial, settings, six=way == SIX) for way in (OWN, SIX)}
                found.append({way: at_readings(settings, *run, trial.gyro, trial.rate) for way, run in runs.items()})
            return found
        both = []
        for trial in trials:
            both.append(imu_rows(settings, trial.gyro, trial.acceleration, trial.magnetometer, rate=trial.rate))
            both.append(imu_rows(settings, trial.gyro, trial.acceleration, rate=trial.rate))
        longest = max(map(len, both))  # shorter ones repeat their last row
        batch = torch.stack([rows[torch.arange(longest).clamp_max(len(rows) - 1)] for rows in both])
        model, keep = ImuFilter(settings).double(), [("belief", "mean"), ("belief", "cov")]
        out = (RTSSmoother(model) if self.smoother else model).sequence(batch, keep=keep)
        found = []
        for place, trial in enumerate(trials):
            ways = {OWN: ("belief", 2 * place), SIX: ("belief", 2 * place + 1)}
            if self.smoother:
                ways[SMOOTH] = "smoothed", 2 * place
            count = len(both[2 * place])
            moments = {
                way: [out[key, name][row, :count] for name in ("mean", "cov")] for way, (key, row) in ways.items()
            }
            found.append({way: at_readings(settings, *each, trial.gyro, trial.rate) for way, each in moments.items()})
        return found


def settings_for(kind: str, numbers: dict[str, dict]) -> tuple[str, ImuSettings]:
    """Returns the parameters that were learned without a kind of motion; the set ``all`` for a new kind."""
    name = kind if kind in numbers else "all"
    return name, ImuSettings(**numbers[name])


def rows_of(
    trial: Trial, own: dict[str, Orientations], numbers: str, settings: ImuSettings, gains: dict[str, dict]
) -> Iterator[dict]:
    """Yields the rows of all methods on one trial.

    Args:
        trial: with readings and truth.
        own: the filter's orientations by method, extrapolated by the latency.
        numbers: name of the filter's set of parameters.
        settings: of the filter.
        gains: of Madgwick's and Mahony's filter, by kind.
    """

    def scored(method: str, quaternion: Tensor, std: Tensor | None = None) -> dict:
        told = {"trial": trial.name, "kind": trial.kind, "method": method, "numbers": numbers}
        return {**told, **scores(trial, quaternion, std)}

    def both(method: str, quaternion: Tensor) -> Iterator[dict]:
        yield scored(method, quaternion)
        yield scored(method + MOVED, moved(quaternion, settings.latency))

    def moved(quaternion: Tensor, by: float) -> Tensor:
        return SO3().plus(quaternion, trial.gyro * by)

    for method, found in own.items():
        yield scored(method + MOVED, found.quaternion, found.std)
        if method != SMOOTH:
            yield scored(method, moved(found.quaternion, -settings.latency), found.std)
    if has(VQF):
        for method, quaternion in zip((VQF, VQF_SIX), vqf(trial), strict=True):
            yield from both(method, quaternion)
    start = first_orientation(trial)
    for name, gain in gains.items():
        if has(name):
            best = gain.get(trial.kind, gain["all"])
            yield scored(name, gradient_filter(name, best, trial, start))
    yield scored("gyro alone", by_gyro(trial, start))


def by_gyro(trial: Trial, start: Tensor) -> Tensor:
    """Returns orientations by the gyro alone, from an initial orientation."""
    found = torch.cat([start.unsqueeze(0), SO3().exp(trial.gyro[1:] / trial.rate)])
    reach = 1
    while reach < len(found):  # cumulative products by doubling
        found = torch.cat([found[:reach], SO3().compose(found[:-reach], found[reach:])])
        reach *= 2
    return found


def page(rows: Sequence[dict], smoke: bool = False) -> str:
    """Returns the tables, in Markdown."""
    names = list(dict.fromkeys(row["trial"] for row in rows))
    methods = [method for method in METHODS if pick(rows, method=method)]
    north = [method for method in methods if "6 axes" not in method]
    text = [f"# Orientation on BROAD\n\nMean over {len(names)} trials, root mean square errors in degrees.\n"]
    text += head("method", "total", "heading", "inclination", "worst total")
    for method in methods:
        own = pick(rows, method=method)
        cells = [mean(own, "total"), mean(own, "heading"), mean(own, "inclination"), max(row["total"] for row in own)]
        known = (True, True, True, True) if method in north else (False, False, True, False)
        text.append(line(method, *(f"{cell:.2f}" if shown else "" for cell, shown in zip(cells, known, strict=True))))
    with_std = [method for method in methods if pick(rows, method=method)[0].get("heading_held") is not None]
    text += ["", "Coverage of the 90 % intervals, %, averaged over trials; heading and inclination.", ""]
    text += head("method", "all trials", "undisturbed", "disturbed")
    for method in with_std:
        own = pick(rows, method=method)
        parts = own, *([row for row in own if ("_disturbed" in row["trial"]) == hit] for hit in (False, True))
        text.append(line(method, *(coverage(part, method in north) for part in parts)))
    own_coverage = " / ".join(HELD)
    text += [
        "",
        f"Total error of each trial, degrees, and coverage ({own_coverage}) of the intervals of {OWN}{MOVED}, %.",
        "",
    ]
    text += head("trial", *north, "coverage")
    for name in names:
        cells = [f"{pick(rows, trial=name, method=method)[0]['total']:.2f}" for method in north]
        text.append(line(name, *cells, coverage(pick(rows, trial=name, method=OWN + MOVED))))
    text += ["", "Inclination of each trial, degrees.", "", *head("trial", *methods)]
    for name in names:
        cells = [f"{pick(rows, trial=name, method=method)[0]['inclination']:.2f}" for method in methods]
        text.append(line(name, *cells))
    data = "simulated" if smoke else "Laidig et al. 2021, CC BY 4.0"
    text += ["", *made_by("broad"), f"* Data: {data}. Numbers: `numbers.json`, see the README.", ""]
    return "\n".join(text)


def coverage(rows: Sequence[dict], north: bool = True) -> str:
    """Returns the mean coverage of rows, in percent."""
    shown = HELD if north else HELD[1:]
    return " / ".join(f"{100 * mean(rows, f'{each}_held'):.0f}" for each in shown) if rows else ""


def mean(rows: Sequence[dict], name: str) -> float:
    """Returns the mean of a column."""
    return fmean(row[name] for row in rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the study."""
    study = parse(Study, arguments)
    for name in PACKAGES:
        if not has(name):
            print(f'{name} is left out: pip install {PACKAGES[name]}, or "torch_denkf[bench]"')
    numbers = json.loads(NUMBERS.read_text())["numbers"]
    gains = json.loads(GAINS.read_text())["gains"]
    trials = [simulated_trial()] if study.smoke else read_trials(study.data)
    runner = Runner(study.smoother, study.equations)
    groups: dict[ImuSettings, list[tuple[Trial, str]]] = {}
    for trial in trials:
        name, settings = settings_for(trial.kind, numbers)
        groups.setdefault(settings, []).append((trial, f"without {name}" if name == trial.kind else name))
    rows: list[dict] = []
    worst: tuple[float, Trial, Orientations] | None = None
    for settings, group in groups.items():
        for some in [group[first : first + TOGETHER] for first in range(0, len(group), TOGETHER)]:
            for (trial, name), own in zip(some, runner(settings, [trial for trial, _ in some]), strict=True):
                for row in rows_of(trial, own, name, settings, gains):
                    rows.append(row)
                    found = {score: round(row[score], 2) for score in SCORES if score in row}
                    print(trial.name, row["method"], found, flush=True)
                total = next(row["total"] for row in pick(rows, trial=trial.name, method=OWN + MOVED))
                if worst is None or total > worst[0]:
                    worst = total, trial, own[OWN]
    rows.sort(key=lambda row: (row["trial"], METHODS.index(row["method"])))
    if study.out is not None:
        study.out.mkdir(parents=True, exist_ok=True)
        write_table(rows, study.out / "broad.csv", ())
        write_text(study.out / "broad.json", json.dumps(rows, indent=1) + "\n")
        assert worst is not None
        draw(worst[1], worst[2], vqf(worst[1])[0] if has(VQF) else None, study.out / "broad.png")
    write_page(page(rows, study.smoke), None if study.out is None else study.out / "broad.md")
