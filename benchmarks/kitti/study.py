"""Leave one drive out: who plays which part, and the jobs of the table, each of which can be broken off and resumed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path

import torch
from tqdm import tqdm

from benchmarks.kitti.evaluation import evaluate
from benchmarks.kitti.folds import Fold, Part, statistics, with_disturbances, with_spans
from benchmarks.kitti.plots import draw_drive
from benchmarks.kitti.sensors import SENSORS, SensorOfFold, sensor_of_fold, train_sensor
from benchmarks.kitti.streams import Stream, find_streams, prepare, spans
from benchmarks.kitti.training import Budget, train_filter
from torch_denkf.data import render_drives

RENDERED_FRAMES = 160
SHARED = ("dead_reckoning", "floor")  # rows that come with every filter


@dataclass(frozen=True)
class Study:
    """All that a job needs to know."""

    root: Path
    out: Path
    size: tuple[int, int] = (125, 414)  # of the images from which the flow is computed
    drives: tuple[str, ...] = ()  # all that are found
    rendered: int = 0  # drives to render for pre-training
    budget: Budget = field(default_factory=Budget)
    processes: int = 1

    @property
    def cache(self) -> Path:
        """Streams."""
        return self.out / "streams"

    def streams(self) -> list[Stream]:
        """The drives of the study."""
        return find_streams(self.root, self.size, list(self.drives) or None)

    def rendered_parts(self) -> tuple[list[Part], list[Part]]:
        """Rendered drives along invented paths, with traffic, to train the sensor on; and others that it does not see.

        Each is seen by a camera that is turned up or down a little, as another car's would be.
        """
        if not self.rendered:
            return [], []
        root, names = self.out / "rendered", [f"r{number:02d}" for number in range(self.rendered)]
        render_drives(root, names=names, frames=RENDERED_FRAMES, size=self.size, processes=self.processes)
        pitches = (torch.rand(self.rendered, generator=torch.Generator().manual_seed(0)) * 2 - 1) * 0.03
        streams = [
            Stream(str(root), name, "image_2", size=self.size, pitch=round(float(pitch), 4))
            for name, pitch in zip(names, pitches, strict=True)
        ]
        held_out = max(self.rendered // 6, 1)
        return [Part(stream) for stream in streams[held_out:]], [Part(stream) for stream in streams[:held_out]]


def make_fold(test: str, streams: Sequence[Stream], train: Sequence[Part], held_out: Sequence[Part]) -> Fold:
    """The fold that leaves ``test`` out.

    All others train both sensor and filter, see ``unseen_readings``; rendered drives validate, or, without them, the
    drive that follows the test drive.
    """
    drives = list(dict.fromkeys(stream.drive for stream in streams))
    of = {drive: [stream for stream in streams if stream.drive == drive] for drive in drives}
    at = drives.index(test)
    others = [*drives[at + 1 :], *drives[:at]]

    def parts(names: Sequence[str], weight: float = 1.0) -> list[Part]:
        return [Part(s, weight=weight / len(names) / len(of[name])) for name in names for s in of[name]]

    if len(others) < 2 + (not held_out):
        raise ValueError(f"{len(drives)} drives are too few to leave {test} out; add drives, or --rendered ones")
    if not held_out:
        own, checked = parts(sorted(others[1:], key=lambda name: -_rows(of[name][0]))), parts(others[:1])
        return Fold(test, with_spans(with_disturbances(own)), *map(with_disturbances, (own, checked)), test=of[test])
    own = parts(sorted(others, key=lambda name: -_rows(of[name][0])))
    rendered = [replace(part, weight=1.5 / len(train)) for part in train]
    checked = [replace(part, weight=1 / len(held_out)) for part in held_out]
    sensor = with_spans([*with_disturbances(own), *with_disturbances(rendered)])
    tune = [*own, *(replace(part, weight=0.3 * part.weight) for part in checked)]
    return Fold(test, sensor, with_disturbances(tune), with_disturbances(checked), test=of[test])


def _rows(stream: Stream) -> int:
    return sum(1 for _ in (Path(stream.root) / "sequences" / stream.drive / stream.camera).glob("*.png"))


@dataclass(frozen=True)
class Job:
    """Some filters on one sensor on one fold from one seed: they share the sensor's weights and its readings."""

    study: Study
    fold: Fold
    filters: tuple[str, ...]
    sensor: str
    seed: int
    rendered: tuple[tuple[Part, ...], tuple[Part, ...]] = ((), ())

    def out(self, name: str) -> Path:
        """Checkpoints, logs and rows of one filter."""
        return self.study.out / "folds" / f"{self.fold.name}-{name}-{self.sensor}-{self.seed}"

    def base(self) -> SensorOfFold:
        """The sensor, trained, and its readings."""
        torch.set_num_threads(1)
        budget = self.study.budget
        return sensor_of_fold(
            self.fold,
            self.sensor,
            out=self.study.out / "sensors" / f"{self.fold.name}-{self.sensor}-{self.seed}",
            cache=self.study.cache,
            seed=self.seed,
            updates=budget.sensor,
            fine_tuning=budget.fine_tuning,
            pretrained=self.pretrain() if self.rendered[0] else None,
        )

    def train(self, name: str, base: SensorOfFold):
        """Trains one filter, or goes on where it was broken off."""
        loggers = ("csv", "tensorboard")
        settings = {"cache": self.study.cache, "seed": self.seed, "budget": self.study.budget, "loggers": loggers}
        return train_filter(self.fold, name, base, out=self.out(name), **settings)

    def run(self) -> None:
        """Trains, evaluates and draws what is not done already; leaves the rows in each filter's folder."""
        left = [name for name in self.filters if not (self.out(name) / "rows.json").exists()]
        base = self.base() if left else None
        for name in left:
            names = {"filter_name": name, "kind": self.sensor, "seed": self.seed}
            plots = self.study.out / "plots" if self.seed == 0 else None
            rows = evaluate_and_draw(*self.train(name, base), self.fold.test, self.study.cache, plots, **names)
            beside = self.out(name) / "rows.json.part"
            beside.write_text(json.dumps(rows))
            beside.replace(self.out(name) / "rows.json")

    def pretrain(self):
        """The sensor that all folds of this seed begin with."""
        study, parts = self.study, with_spans(with_disturbances(self.rendered[0]))
        torch.manual_seed(self.seed)
        facts = statistics(parts, study.cache)
        return train_sensor(
            SENSORS[self.sensor](facts),
            parts,
            with_disturbances(self.rendered[1]),
            kind=self.sensor,
            facts=facts,
            out=study.out / "pretrained" / f"{self.sensor}-{self.seed}",
            cache=study.cache,
            seed=self.seed,
            updates=study.budget.sensor,
        )

    def prepare_sensor(self) -> None:
        """Does :meth:`pretrain` ahead of all folds, so that no two do it at once."""
        torch.set_num_threads(1)
        self.pretrain()


def evaluate_and_draw(recipe, model, streams: Sequence[Stream], cache: Path, plots: Path | None, **names) -> list[dict]:
    """Rows of some drives, and pictures of each, clean and with missing frames, in a folder if one is given."""
    rows = []
    for stream in streams:
        own, beliefs = evaluate(recipe, model, stream, cache, **names)
        rows += own
        for condition in ("clean", "missing") if plots else ():
            shown = [row for row in own if row["condition"] == condition]
            method = f"{names['filter_name']}-{names['kind']}"
            title = f"{stream.name}, {condition}: {method}, on a drive that it has not seen"
            plots.mkdir(parents=True, exist_ok=True)
            picture = plots / f"{stream.drive}-{stream.camera}-{method}-{condition}.png"
            draw_drive(beliefs[condition], shown, title, recipe.facts.dt, picture)
    return rows


def make_jobs(
    study: Study, filters: Sequence[str], sensors: Sequence[str], seeds: int, tests: Sequence[str]
) -> list[Job]:
    """Every combination; seeds last, so that a study that is broken off has whole folds."""
    streams, rendered = study.streams(), study.rendered_parts()
    names = list(dict.fromkeys(stream.drive for stream in streams))
    folds = [make_fold(name, streams, *rendered) for name in (tests or names)]
    both = (tuple(rendered[0]), tuple(rendered[1]))
    return [
        Job(study, fold, tuple(filters), sensor, seed, both)
        for seed in range(seeds)
        for sensor in sensors
        for fold in folds
    ]


def prepare_jobs(jobs: Sequence[Job], processes: int) -> None:
    """Computes all streams that the jobs read."""
    streams = []
    for job in jobs:
        streams += [part.stream for part in job.fold.train if part.stream.steps == 1 or job.sensor == "flow"]
        read = [*job.fold.tune, *job.fold.validation, *with_disturbances([Part(stream) for stream in job.fold.test])]
        streams += [stream for part in read for stream in spans(part.stream, job.sensor)]
    prepare(list(dict.fromkeys(streams)), jobs[0].study.cache, processes)


def run_jobs(jobs: Sequence[Job], processes: int) -> None:
    """Computes all streams, pre-trains, then runs all folds side by side."""
    prepare_jobs(jobs, processes)
    first = {(job.sensor, job.seed): job for job in jobs if job.rendered[0]}
    _side_by_side([job.prepare_sensor for job in first.values()], processes, "training on rendered drives")
    _side_by_side([job.run for job in jobs], processes, "folds")


def read_rows(out: Path) -> list[dict]:
    """All rows that a study's folder holds: filters, sensors and seeds may come from several calls.

    Each filter's rows bring dead reckoning with its sensor and the floor; those of the first one are kept.
    """
    rows, seen = [], set()
    for file in sorted((out / "folds").glob("*/rows.json"), key=lambda file: ("-denkf-" not in file.parent.name, file)):
        own = json.loads(file.read_text())
        shared = {_identity(row) for row in own if row["filter"] in SHARED}
        rows += [row for row in own if _identity(row) not in seen]
        seen |= shared
    return rows


def _identity(row: dict) -> tuple:
    return tuple(row[key] for key in ("filter", "sensor", "drive", "condition", "window", "seed"))


def _side_by_side(calls: Sequence, processes: int, title: str) -> None:
    if processes < 2:
        for call in tqdm(calls, desc=title, disable=None):
            call()
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(call) for call in calls]
        for future in tqdm(as_completed(futures), total=len(futures), desc=title, disable=None):
            future.result()  # raises what the job raised


def describe(study: Study) -> dict:
    """The settings, for the record."""
    return {key: str(value) if isinstance(value, Path) else value for key, value in asdict(study).items()}
