"""The study's options, and the jobs of its table, each of which can be interrupted and resumed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from typing import Literal

import torch
from tensordict import TensorDict
from torch import Tensor
from tyro.conf import OmitArgPrefixes, Positional

from benchmarks.common.arguments import some_of
from benchmarks.common.arm import JOINTS, scores
from benchmarks.common.arm.motion import train_motion, with_rates
from benchmarks.common.arm.readings import Windows, fail, read_all
from benchmarks.common.jobs import once
from benchmarks.g1.base import SensorBudget, TrainedSensor
from benchmarks.g1.baselines import SensorSpread, baselines
from benchmarks.g1.disturbances import PICTURES
from benchmarks.g1.motion import AHEAD, Motion, delayed
from benchmarks.g1.recipes import FILTERS, MEMBERS, G1Recipe
from benchmarks.g1.recordings import NAMES, Recordings
from torch_denkf.filters import Filter

CONDITIONS = ("clean", "black20", "missing", *PICTURES[1:])
SHARES = (0.5, 0.08, 0.22, 0.12, 0.08)  # of the filters' training windows, by PICTURES
INFLATIONS = (0.7, 0.85, 1.0, 1.2, 1.45, 1.75, 2.1)
score_row = partial(scores.score_row, names=NAMES, unit=torch.full((JOINTS,), torch.pi / 180))


@dataclass(frozen=True)
class FilterBudget:
    """Updates of each stage, and the size of the filter's windows."""

    motion: int = 1500  # updates of the motion on true states
    spread: int = 600  # updates of the sensor's variance
    filter: int = 45  # updates of a filter on readings
    length: int = 64  # rows of the filter's windows
    batch: int = 8  # windows in an update


@dataclass(frozen=True)
class Study(Recordings):
    """Estimates seven joints of a real arm from its robot's head camera, with every registered filter.

    table: train sensors and filters, test. diagnosis: correlation of the trained sensors' errors in time. pictures:
    plots of the beliefs that a table saved in --out. An interrupted run resumes. See benchmarks/g1/README.md.
    """

    command: Positional[Literal["table", "diagnosis", "pictures"]] = "table"
    filters: some_of(sorted(FILTERS)) = tuple(sorted(FILTERS))
    seeds: tuple[int, ...] = (0, 1, 2)
    sensor_budget: OmitArgPrefixes[SensorBudget] = field(default_factory=SensorBudget)
    budget: OmitArgPrefixes[FilterBudget] = field(default_factory=FilterBudget)
    smoke: bool = False  # a tiny run of everything, on synthetic images


class Base:
    """Readings, motion and error model that all filters of a seed share.

    Args:
        study: the study.
        sensor: trained.
    """

    def __init__(self, study: Study, sensor: TrainedSensor):
        self.study, self.trained = study, sensor
        self.name, self.sequences = f"arm-{sensor.name}", sensor.sequences()
        self.starts = torch.stack([state[0] for state, _ in self.sequences])  # of episodes, [N, D]
        self.motion = cache(self._motion)

    def _pictures(self, role: str) -> dict[str, TensorDict]:
        """Returns the sensor's readings of a role's episodes under all image conditions, with raw encodings."""
        out = {}
        for condition in PICTURES:
            readings = read_all(self.trained.trained[0], self.trained.codes(role, condition), MEMBERS)
            samples, encoding = readings["sensor", "ensemble"], readings["sensor", "encoding"]
            spread = samples.std(-2).clamp_min(1e-5).log()
            sensor = {"ensemble": samples[..., :JOINTS].clone(), "encoding": torch.cat([encoding, spread], -1)}
            readings["sensor"] = TensorDict(sensor, readings.batch_size)
            out[condition] = readings.set("start", self.starts.mean(0).expand_as(readings["state"]))
        return out

    @cached_property
    def _tune(self) -> dict[str, TensorDict]:
        return self._pictures("tune")

    @cached_property
    def _encoding(self) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation of the tuning episodes' encodings under all image conditions."""
        seen = torch.cat([one["sensor", "encoding"][one["observed"].squeeze(-1)] for one in self._tune.values()])
        return seen.mean(0), seen.std(0).clamp_min(1e-3)

    def readings(self, role: str) -> dict[str, TensorDict]:
        """Returns the sensor's readings of a role's episodes under all conditions, with normalised encodings."""
        pictures, (loc, scale), out = self._tune if role == "tune" else self._pictures(role), self._encoding, {}
        for condition, one in pictures.items():
            sensor = one["sensor"].copy()
            sensor["encoding"] = ((sensor["encoding"] - loc) / scale).clamp(-5, 5)
            out[condition] = one.copy().set("sensor", sensor)
        return {name: out[name] if name in out else fail(out["clean"], name) for name in CONDITIONS}

    @cached_property
    def tune(self) -> dict[str, TensorDict]:
        """Returns the readings for training filters."""
        return self.readings("tune")

    @cached_property
    def validation(self) -> dict[str, TensorDict]:
        """Returns the readings for validation."""
        return self.readings("validation")

    @cached_property
    def test(self) -> dict[str, TensorDict]:
        """Returns readings of the test episodes."""
        return self.readings("test")

    @cached_property
    def spread(self) -> SensorSpread:
        """Returns the model of the variance of the sensor's errors."""
        tune, validation = ([one[name] for name in PICTURES] for one in (self.tune, self.validation))
        return SensorSpread(tune, validation, self.study.out / "spreads" / self.name, self.study.budget.spread)

    def _motion(self, actions: bool) -> Motion:
        """Returns the motion, trained once on true states."""
        seed, study = self.trained.seed, self.study
        torch.manual_seed(seed)
        paths = [torch.cat([with_rates(state, 1), delayed(action)], -1) for state, action in self.sequences]
        out = study.out / "motions" / f"arm{'-actions' * actions}-{seed}"
        motion = Motion(self.trained.trained[1], actions)
        return train_motion(motion, paths, AHEAD, out=out, seed=seed, updates=study.budget.motion)

    def train(self, name: str) -> tuple[G1Recipe, Filter]:
        """Trains a filter, or loads it."""
        kind, budget, clean = FILTERS[name], self.study.budget, self.validation["clean"]
        wrong = (clean["sensor", "ensemble"].mean(-2) - clean["state"])[clean["observed"].squeeze(-1)]
        error, first = wrong.square().mean(0).sqrt().clamp_min(1e-4), self.starts.std(0).clamp_min(1e-3)
        recipe = kind(self.motion(kind.actions), error, first, self.spread.noise)
        windows = Windows([self.tune[name] for name in PICTURES], budget.length, SHARES)
        validation, updates = joined(self.validation), budget.filter * recipe.longer
        torch.manual_seed(self.trained.seed)
        model = recipe.build()

        def stages():
            return [scores.filter_stage(recipe, model, windows, validation, updates, budget.batch, lr=2e-3)]

        out = self.study.out / "filters" / f"{name}-{self.name}"
        settings = {"inflations": INFLATIONS, "every": updates // 3, "out": out, "seed": self.trained.seed}
        return recipe, scores.fit(recipe, model, stages, lambda: validation, **settings)


def joined(readings: dict[str, TensorDict]) -> TensorDict:
    """Returns readings of all conditions as one batch."""
    return torch.cat(list(readings.values()))


def run_all(study: Study) -> None:
    """Trains and tests the missing filters; writes their rows to ``--out/rows``."""
    for seed in study.seeds:
        base, folder = Base(study, TrainedSensor(study, seed, study.sensor_budget)), study.out / "rows"
        once(folder / f"baselines-{base.name}.json", partial(_baselines, base, {"seed": seed}))
        for name in study.filters:
            once(folder / f"{name}-{base.name}.json", partial(_filter, base, {"seed": seed, "filter": name}))


def _baselines(base: Base, names: dict) -> list[dict]:
    states = [state for state, _ in base.sequences]
    return [
        {**names, "filter": name, **score_row(out, condition)}
        for condition, readings in base.test.items()
        for name, out in baselines(readings, states, base.spread).items()
    ]


def _filter(base: Base, names: dict) -> list[dict]:
    recipe, model = base.train(names["filter"])
    rows = scores.filter_rows(recipe, model, base.test, lambda out, condition: {**names, **score_row(out, condition)})
    validation = scores.run_filter(recipe, model, joined(base.validation))
    rows[0]["validation_crps"] = score_row(validation, "validation")["crps"]
    if names["filter"] == "denkf":
        scores.save_beliefs(recipe, model, base.test, f"denkf-{base.name}", base.study.out / "beliefs")
    return rows


def diagnosis(sensor: TrainedSensor) -> str:
    """Returns the correlation of a sensor's errors in time, on tuning and validation episodes."""
    errors = []
    for role in ("tune", "validation"):
        readings = read_all(sensor.trained[0], sensor.codes(role), 64)
        wrong = readings["sensor", "ensemble"].mean(-2)[..., :JOINTS] - readings["state"]
        errors += [one[at] for one, at in zip(wrong, readings["valid"].squeeze(-1), strict=True)]
    parts = []
    for step in (1, 10, 30):
        both = sum((error[step:] * error[:-step]).sum() for error in errors)
        norm = sum((error[step:].square().sum() * error[:-step].square().sum()).sqrt() for error in errors)
        parts.append(f"{step}: {float(both / norm):.2f}")
    return f"Sensor `{sensor.name}`: correlation of the errors of all joints after so many rows: {', '.join(parts)}."
