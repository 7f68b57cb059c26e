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

from kitti_study.evaluation import evaluate
from kitti_study.filters import SENSORS
from kitti_study.fold import Fold, Part, statistics, with_disturbances, with_spans
from kitti_study.plots import draw_drive
from kitti_study.streams import Stream, find_streams, prepare, spans
from kitti_study.training import Budget, train_fold, train_sensor
from torch_denkf.data import render_drives

RENDERED_FRAMES = 160


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

    Without rendered drives the three that follow the test drive, in turn, validate (one) and tune (two). With them all
    drives train both sensor and filter, and rendered drives validate.
    """
    drives = list(dict.fromkeys(stream.drive for stream in streams))
    of = {drive: [stream for stream in streams if stream.drive == drive] for drive in drives}
    at = drives.index(test)
    others = [*drives[at + 1 :], *drives[:at]]

    def parts(names: Sequence[str], weight: float = 1.0) -> list[Part]:
        return [Part(s, weight=weight / len(names) / len(of[name])) for name in names for s in of[name]]

    if not held_out:
        tuning = 2 if len(others) > 4 else 1
        validation, tune, rest = others[:1], others[1 : 1 + tuning], others[1 + tuning :]
        if not rest:
            raise ValueError(f"{len(drives)} drives are too few to leave {test} out; add drives, or --rendered ones")
        sensor, tuned, checked = parts(rest), parts(tune), parts(validation)
        return Fold(
            test, with_spans(with_disturbances(sensor)), *map(with_disturbances, (tuned, checked)), test=of[test]
        )
    if len(others) < 2:
        raise ValueError(f"{len(drives)} drives are too few to leave {test} out; two must be left")
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
    """One filter with one sensor on one fold from one seed."""

    study: Study
    fold: Fold
    filter: str
    sensor: str
    seed: int
    rendered: tuple[tuple[Part, ...], tuple[Part, ...]] = ((), ())

    @property
    def out(self) -> Path:
        """Checkpoints, logs and rows."""
        return self.study.out / "folds" / f"{self.fold.name}-{self.filter}-{self.sensor}-{self.seed}"

    def train(self):
        """Trains, or goes on where it was broken off; returns the filter and the training drives' statistics."""
        torch.set_num_threads(1)
        return train_fold(
            self.fold,
            self.filter,
            self.sensor,
            out=self.out,
            cache=self.study.cache,
            seed=self.seed,
            budget=self.study.budget,
            pretrained=self.pretrain() if self.rendered[0] else None,
            loggers=("csv", "tensorboard"),
        )

    def run(self) -> list[dict]:
        """Trains, evaluates and draws; what is done already is read."""
        file = self.out / "rows.json"
        if file.exists():
            return json.loads(file.read_text())
        model, facts = self.train()
        names = {"filter_name": self.filter, "kind": self.sensor, "seed": self.seed}
        plots = self.study.out / "plots" if self.seed == 0 else None
        rows = evaluate_and_draw(model, facts, self.fold.test, self.study.cache, plots, **names)
        beside = file.with_suffix(".part")
        beside.write_text(json.dumps(rows))
        beside.replace(file)
        return rows

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


def evaluate_and_draw(model, facts, streams: Sequence[Stream], cache: Path, plots: Path | None, **names) -> list[dict]:
    """Rows of some drives, and pictures of each, clean and with missing frames, in a folder if one is given."""
    rows = []
    for stream in streams:
        own, beliefs = evaluate(model, facts, stream, cache, **names)
        rows += own
        for condition in ("clean", "missing") if plots else ():
            shown = [row for row in own if row["condition"] == condition]
            method = f"{names['filter_name']}-{names['kind']}"
            title = f"{stream.name}, {condition}: {method}, on a drive that it has not seen"
            plots.mkdir(parents=True, exist_ok=True)
            picture = plots / f"{stream.drive}-{stream.camera}-{method}-{condition}.png"
            draw_drive(beliefs[condition], shown, title, facts.dt, picture)
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
        Job(study, fold, name, sensor, seed, both)
        for seed in range(seeds)
        for sensor in sensors
        for name in filters
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


def run_jobs(jobs: Sequence[Job], processes: int) -> list[dict]:
    """Computes all streams, pre-trains, then runs all folds side by side."""
    prepare_jobs(jobs, processes)
    first = {(job.sensor, job.seed): job for job in jobs if job.rendered[0]}
    _side_by_side([job.prepare_sensor for job in first.values()], processes, "training on rendered drives")
    return [row for rows in _side_by_side([job.run for job in jobs], processes, "folds") for row in rows]


def _side_by_side(calls: Sequence, processes: int, title: str) -> list:
    if processes < 2:
        return [call() for call in tqdm(calls, desc=title, disable=None)]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(call) for call in calls]
        for future in tqdm(as_completed(futures), total=len(futures), desc=title, disable=None):
            future.result()  # raises what the job raised
        return [future.result() for future in futures]


def describe(study: Study) -> dict:
    """The settings, for the record."""
    return {key: str(value) if isinstance(value, Path) else value for key, value in asdict(study).items()}
