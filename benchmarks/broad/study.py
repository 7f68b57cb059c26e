"""The study: its options, its rows, its tables."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from benchmarks.broad.learning import Equations, beliefs
from benchmarks.broad.pictures import draw
from benchmarks.broad.task import Trial, read_trials, scores, simulated_trial
from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import Columns, head, line, pick, write_page
from torch_denkf.applications.imu.filter import ImuFilter, ImuSettings
from torch_denkf.applications.imu.log import Orientations, at_readings, imu_rows
from torch_denkf.deployment.files import write_text
from torch_denkf.functional.manifolds import SO3
from torch_denkf.smoothers import RTSSmoother

HAS_VQF = find_spec("vqf") is not None
NUMBERS = Path(__file__).parent / "numbers.json"
HELD = ("heading", "inclination")
SCORES = ("total", "heading", "inclination", "heading_held", "inclination_held", "heading_std", "seconds")
COLUMNS = Columns(
    names=("trial", "kind", "method", "numbers", *SCORES),
    text=("trial", "kind", "method", "numbers"),
    whole=(),
    order=lambda row: (row["trial"], METHODS.index(row["method"])),
)
OWN, SIX, SMOOTH = "filter", "filter, 6 axes", "smoother"
STAMPED = ", readings as stamped"  # without the learned latency
VQF, VQF_SIX, LATE = "VQF", "VQF, 6 axes", "VQF, moved on by the learned latency"
GYRO = "gyro alone"
METHODS = (OWN, OWN + STAMPED, SIX, SIX + STAMPED, SMOOTH, VQF, LATE, VQF_SIX, GYRO)


@dataclass(frozen=True)
class Study:
    """Compares orientation filters on the trials of BROAD."""

    data: Path = Path("../shared/data/broad")  # folder with .npz files of BROAD
    out: Path | None = None  # folder for broad.csv, broad.json, broad.md and broad.png
    smoother: bool = True  # run the smoother, too
    equations: bool = False  # the filter by equations.c, a second a trial; a test compares it with the library's
    compile: bool = True  # the filter's steps: a minute, and a twentieth of the time
    smoke: bool = False  # ten simulated seconds: does it run?


class Runner:
    """Runs one filter with the numbers of any settings: it is compiled once.

    Args:
        compiled: whether it is compiled at all.
        equations: whether the equations in C run in its place.
    """

    def __init__(self, compiled: bool, equations: bool = False):
        self.equations = Equations() if equations else None
        self.model = ImuFilter(ImuSettings()).double()
        if compiled:
            self.model.compile(chunk=1)
        self.smoother = RTSSmoother(self.model)

    @torch.no_grad()
    def __call__(self, settings: ImuSettings, trial: Trial, *, six: bool = False, smooth: bool = False) -> Orientations:
        """The orientations of a trial."""
        if self.equations is not None:
            mean, cov = beliefs(self.equations, trial, settings, six=six, smooth=smooth)
            return at_readings(settings, mean, cov, trial.gyro, trial.rate)
        self.model.load_state_dict(ImuFilter(settings).double().state_dict())
        field = None if six else trial.magnetometer
        rows = imu_rows(settings, trial.gyro, trial.acceleration, field, rate=trial.rate)
        prefix = "smoothed" if smooth else "belief"
        keys = [(prefix, "mean"), (prefix, "cov")]
        out = self.smoother.sequence(rows, keep=[]) if smooth else self.model.sequence(rows, keep=keys)
        return at_readings(settings, out[prefix, "mean"], out[prefix, "cov"], trial.gyro, trial.rate)


def settings_for(kind: str, numbers: dict[str, dict]) -> tuple[str, ImuSettings]:
    """Returns the numbers that were learned without a kind of motion; those of all for a kind that was not there."""
    name = kind if kind in numbers else "all"
    return name, ImuSettings(**numbers[name])


def rows_of(trial: Trial, numbers: dict[str, dict], runner: Runner, smoother: bool) -> Iterator[tuple[dict, Tensor]]:
    """Rows of all methods on one trial, and the orientations."""
    name, settings = settings_for(trial.kind, numbers)
    told = {"trial": trial.name, "kind": trial.kind}

    def scored(method: str, quaternion: Tensor, std: Tensor | None = None, **more) -> tuple[dict, Tensor]:
        return {**told, "method": method, **more, **scores(trial, quaternion, std)}, quaternion

    own = {"numbers": f"without {name}" if name == trial.kind else name}
    for method, six in ((OWN, False), (SIX, True)):
        began = time.process_time()
        found = runner(settings, trial, six=six)
        seconds = time.process_time() - began
        yield scored(method, found.quaternion, found.std, **own, seconds=seconds)
        still = replace(settings, latency=0.0)
        stamped = at_readings(still, found.mean, found.cov, trial.gyro, trial.rate)
        yield scored(method + STAMPED, stamped.quaternion, stamped.std, **own)
    if smoother:
        found = runner(settings, trial, smooth=True)
        yield scored(SMOOTH, found.quaternion, found.std, **own)
    if HAS_VQF:
        nine, six_axes, seconds = vqf(trial)
        yield scored(VQF, nine, seconds=seconds)
        yield scored(LATE, SO3().plus(nine, trial.gyro * settings.latency), **own)
        yield scored(VQF_SIX, six_axes)
    yield scored(GYRO, by_gyro(trial, settings))


def vqf(trial: Trial) -> tuple[Tensor, Tensor, float]:
    """Orientations of VQF with its default settings, 9 and 6 axes, and its seconds."""
    from vqf import VQF as Filter

    began = time.process_time()
    sensors = (trial.gyro, trial.acceleration, trial.magnetometer)
    out = Filter(1 / trial.rate).updateBatch(*(value.numpy().copy() for value in sensors))
    return torch.as_tensor(out["quat9D"]), torch.as_tensor(out["quat6D"]), time.process_time() - began


def by_gyro(trial: Trial, settings: ImuSettings) -> Tensor:
    """Orientations by the gyro alone, from what the first readings of all sensors say."""
    start = imu_rows(settings, trial.gyro[:100], trial.acceleration[:100], trial.magnetometer[:100], rate=trial.rate)
    found = torch.cat([start["start"][:1, :4], SO3().exp(trial.gyro[1:] / trial.rate)])
    reach = 1
    while reach < len(found):  # products of all before, twice as many each time
        found = torch.cat([found[:reach], SO3().compose(found[:-reach], found[reach:])])
        reach *= 2
    return found


def page(rows: Sequence[dict], smoke: bool = False) -> str:
    """The tables, in Markdown."""
    names = list(dict.fromkeys(row["trial"] for row in rows))
    methods = [method for method in METHODS if pick(rows, method=method)]
    text = [
        "# Orientation on BROAD",
        "",
        f"Mean over {len(names)} trials, degrees; coverage of the 90 % intervals.",
        "",
    ]
    text += head(
        "method", "total", "heading", "inclination", "worst total", "heading held", "inclination held", "CPU s"
    )
    for method in methods:
        own = pick(rows, method=method)
        cells = [f"{mean(own, name):.2f}" for name in ("total", "heading", "inclination")]
        worst = f"{max(row['total'] for row in own):.2f}"
        held = [f"{100 * mean(own, f'{name}_held'):.0f} %" if f"{name}_held" in own[0] else "" for name in HELD]
        seconds = f"{mean(own, 'seconds'):.1f}" if "seconds" in own[0] else ""
        if "6 axes" in method:  # north is unknown
            cells[:2], worst, held[:1] = ["", ""], "", [""]
        text.append(line(method, *cells, worst, *held, seconds))
    north = [method for method in methods if "6 axes" not in method]
    text += ["", "Total error of each trial, degrees, and the coverage of the filter's intervals, %.", ""]
    text += head("trial", *north, "heading held", "inclination held")
    for name in names:
        cells = [f"{pick(rows, trial=name, method=method)[0]['total']:.2f}" for method in north]
        own = pick(rows, trial=name, method=OWN)[0]
        text.append(line(name, *cells, *(f"{100 * own[f'{each}_held']:.0f}" for each in HELD)))
    text += ["", "Inclination of each trial, degrees.", "", *head("trial", *methods)]
    for name in names:
        cells = [f"{pick(rows, trial=name, method=method)[0]['inclination']:.2f}" for method in methods]
        text.append(line(name, *cells))
    data = "simulated" if smoke else "Laidig et al. 2021, CC BY 4.0"
    text += ["", *made_by("broad"), f"* Data: {data}. Numbers: `numbers.json`, see the README.", ""]
    return "\n".join(text)


def mean(rows: Sequence[dict], name: str) -> float:
    """Returns the mean of a column."""
    return fmean(row[name] for row in rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the study."""
    study = parse(Study, arguments)
    if not HAS_VQF:
        print('VQF, the peer, is left out: pip install "torch_denkf[bench]"')
    numbers = json.loads(NUMBERS.read_text())["numbers"]
    trials = [simulated_trial()] if study.smoke else read_trials(study.data)
    runner = Runner(study.compile and not study.smoke, study.equations)
    rows: list[dict] = []
    worst: tuple[float, Trial, Tensor] | None = None
    for trial in trials:
        for row, quaternion in rows_of(trial, numbers, runner, study.smoother):
            rows.append(row)
            if row["method"] == OWN and (worst is None or row["total"] > worst[0]):
                worst = row["total"], trial, quaternion
            print(trial.name, row["method"], {name: round(row[name], 2) for name in SCORES if name in row}, flush=True)
    if study.out is not None:
        study.out.mkdir(parents=True, exist_ok=True)
        COLUMNS.write(rows, study.out / "broad.csv")
        write_text(study.out / "broad.json", json.dumps(rows, indent=1) + "\n")
        assert worst is not None
        _, settings = settings_for(worst[1].kind, numbers)
        found = runner(settings, worst[1])
        draw(worst[1], found, vqf(worst[1])[0] if HAS_VQF else None, study.out / "broad.png")
    write_page(page(rows, study.smoke), None if study.out is None else study.out / "broad.md")
