"""The study's options, and the jobs of its table, each of which can be interrupted and resumed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from tyro.conf import OmitArgPrefixes, Positional

from benchmarks.common.arguments import some_of
from benchmarks.common.jobs import once, read_rows, side_by_side
from benchmarks.kitti.evaluation import evaluate
from benchmarks.kitti.folds import Fold, Part, make_fold, statistics, with_disturbances, with_spans
from benchmarks.kitti.plots import draw_drive
from benchmarks.kitti.recipes import FILTERS
from benchmarks.kitti.sensors import SENSORS, SensorOfFold, SensorTraining, sensor_of_fold
from benchmarks.kitti.streams import Stream, find_streams, prepare, spans
from benchmarks.kitti.tables import IDENTITY
from benchmarks.kitti.training import Budget, train_filter
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.modules import SubModel

RENDERED_FRAMES = 160
SHARED = ("dead_reckoning", "floor")  # rows that each filter's job repeats


@dataclass(frozen=True)
class Study:
    """Evaluates visual odometry on KITTI by the paper's protocol, with every registered filter.

    table: leave out one drive at a time, in all conditions. An interrupted run resumes. See
    benchmarks/kitti/README.md.
    """

    command: Positional[Literal["table"]] = "table"
    root: Path | None = None  # folder with sequences and poses
    out: Path = Path("runs/kitti")  # checkpoints, logs, table and plots
    drives: tuple[str, ...] = ()  # drives of the study; by default all drives in the folder
    test: tuple[str, ...] = ()  # drives to leave out, one at a time; by default all
    filters: some_of(sorted(FILTERS)) = ("denkf",)
    sensors: some_of(sorted(SENSORS)) = ("flow",)
    seeds: int = 1
    rendered: int = 0  # drives to render for a first training of the sensor
    first: Path | None = None  # --out of a table whose rendered drives and first training to use, instead of this --out
    size: tuple[int, int] = (125, 414)  # rows and columns to compute the flow at
    processes: int = 1  # folds in parallel
    budget: OmitArgPrefixes[Budget] = field(default_factory=Budget)
    smoke: bool = False  # a tiny run of everything, on rendered drives

    @property
    def cache(self) -> Path:
        """Returns the folder of the streams."""
        return self.out / "streams"

    @property
    def begun(self) -> Path:
        """Returns the folder of the rendered drives and of the sensor's first training."""
        return self.first or self.out

    def rendered_parts(self) -> tuple[list[Part], list[Part]]:
        """Returns rendered drives along synthetic paths, with traffic, that train the sensor, and held-out ones.

        Each has a slightly different pitch of the camera, as in another car.
        """
        if not self.rendered:
            return [], []
        root, names = self.begun / "rendered", [f"r{number:02d}" for number in range(self.rendered)]
        size = self.size if self.first is None else tuple(_settings(self.first)["size"])
        render_drives(root, names=names, frames=RENDERED_FRAMES, size=size, processes=self.processes)
        pitches = (torch.rand(self.rendered, generator=torch.Generator().manual_seed(0)) * 2 - 1) * 0.03
        parts = [
            Part(Stream(str(root), name, "image_2", size=size, pitch=round(float(pitch), 4)))
            for name, pitch in zip(names, pitches, strict=True)
        ]
        held_out = max(self.rendered // 6, 1)
        return parts[held_out:], parts[:held_out]


def _settings(out: Path) -> dict:
    """Returns the options of the table in a folder."""
    file = out / "settings.json"
    if not file.exists():
        raise FileNotFoundError(f"--first {out} has no settings.json; pass the --out of a table")
    return json.loads(file.read_text())


@dataclass(frozen=True)
class Job:
    """All filters of the study on one sensor, fold and seed, which share the sensor's weights and readings."""

    study: Study
    fold: Fold
    sensor: str
    seed: int
    rendered: tuple[list[Part], list[Part]] = ((), ())

    def out(self, name: str) -> Path:
        """Returns the folder for checkpoints, logs and rows of one filter."""
        return self.study.out / "folds" / f"{self.fold.name}-{name}-{self.sensor}-{self.seed}"

    def base(self) -> SensorOfFold:
        """Returns the trained sensor and its readings."""
        torch.set_num_threads(1)
        return sensor_of_fold(
            self.fold,
            self.sensor,
            out=self.study.out / "sensors" / f"{self.fold.name}-{self.sensor}-{self.seed}",
            cache=self.study.cache,
            seed=self.seed,
            updates=self.study.budget.sensor,
            fine_tuning=self.study.budget.fine_tuning,
            pretrained=self.pretrain() if self.rendered[0] else None,
        )

    def run(self) -> None:
        """Trains, evaluates and draws the missing filters; writes the rows to each filter's folder."""
        base = None
        for name in self.study.filters:
            if (self.out(name) / "rows.json").exists():
                continue
            base = base or self.base()
            once(self.out(name) / "rows.json", lambda name=name, base=base: self.test(name, base))

    def test(self, name: str, base: SensorOfFold) -> list[dict]:
        """Trains one filter and returns its rows; draws plots for seed 0."""
        loggers = ("csv", "tensorboard")
        settings = {"cache": self.study.cache, "seed": self.seed, "budget": self.study.budget, "loggers": loggers}
        trained = train_filter(self.fold, name, base, out=self.out(name), **settings)
        plots = self.study.out / "plots" if self.seed == 0 else None
        names = {"filter_name": name, "kind": self.sensor, "seed": self.seed}
        return evaluate_and_draw(*trained, self.fold.test, self.study.cache, plots, **names)

    def pretrain(self) -> SubModel:
        """Returns the pre-trained sensor from which all folds of this seed start."""
        torch.set_num_threads(1)
        study, parts = self.study, with_spans(with_disturbances(self.rendered[0]))
        torch.manual_seed(self.seed)
        facts = statistics(parts, study.cache)
        training = SensorTraining(self.sensor, facts, study.cache, self.seed)
        out, held_out = study.begun / "pretrained" / f"{self.sensor}-{self.seed}", with_disturbances(self.rendered[1])
        return training.train(SENSORS[self.sensor](facts), parts, held_out, out, study.budget.sensor)

    def prepare_sensor(self) -> None:
        """Runs :meth:`pretrain` before all folds, so that no two processes run it at once."""
        self.pretrain()


def evaluate_and_draw(recipe, model, streams: Sequence[Stream], cache: Path, plots: Path | None, **names) -> list[dict]:
    """Returns rows of some drives; draws each, clean and with missing frames, if a folder is given."""
    rows = []
    for stream in streams:
        own, beliefs = evaluate(recipe, model, stream, cache, **names)
        rows += own
        for condition in ("clean", "missing") if plots else ():
            shown = [row for row in own if row["condition"] == condition]
            method = f"{names['filter_name']}-{names['kind']}"
            title = f"{stream.name}, {condition}: {method}, on a drive that it has not seen"
            picture = plots / f"{stream.drive}-{stream.camera}-{method}-{condition}.png"
            draw_drive(beliefs[condition], shown, title, recipe.facts.dt, picture)
    return rows


def make_jobs(study: Study) -> list[Job]:
    """Returns every combination; seeds vary slowest, so that an interrupted study has all folds of a seed."""
    streams, rendered = find_streams(study.root, study.size, list(study.drives) or None), study.rendered_parts()
    names = study.test or list(dict.fromkeys(stream.drive for stream in streams))
    folds = [make_fold(name, streams, *rendered) for name in names]
    return [
        Job(study, fold, sensor, seed, rendered)
        for seed in range(study.seeds)
        for sensor in study.sensors
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
    """Computes all streams, pre-trains, then runs all folds in parallel."""
    prepare_jobs(jobs, processes)
    first = {(job.sensor, job.seed): job for job in jobs if job.rendered[0]}
    side_by_side([job.prepare_sensor for job in first.values()], processes, "training on rendered drives")
    side_by_side([job.run for job in jobs], processes, "folds")


def rows_of(out: Path) -> list[dict]:
    """Returns all rows in a study's folder; filters, sensors and seeds may come from several calls.

    Each filter's rows include dead reckoning with its sensor and the floor; those of the first filter are kept.
    """
    files = (out / "folds").glob("*/rows.json")
    files = sorted(files, key=lambda file: ("-denkf-" not in file.parent.name, file))
    return read_rows(files, lambda row: tuple(row[key] for key in IDENTITY) if row["filter"] in SHARED else None)
