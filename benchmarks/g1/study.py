"""The study's options, and the jobs of its table, each of which can be broken off and resumed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict
from torch import Tensor
from tyro.conf import OmitArgPrefixes, Positional

from benchmarks.common.arguments import some_of
from benchmarks.common.jobs import once, read_rows
from benchmarks.g1.base import SensorBudget, TrainedSensor
from benchmarks.g1.baselines import Baselines
from benchmarks.g1.evaluation import baseline_rows, filter_rows, save_beliefs
from benchmarks.g1.motion import Motion, train_motion
from benchmarks.g1.readings import (
    CONDITIONS,
    PICTURES,
    Windows,
    black_readings,
    fail,
    read_codes,
    standardised,
    with_readings,
)
from benchmarks.g1.recipes import FILTERS, G1Recipe
from benchmarks.g1.recipes._base import MEMBERS
from benchmarks.g1.recordings import ARM, JOINTS, Recordings, rows_of
from benchmarks.g1.sensors import encoding_size
from benchmarks.g1.training import FilterBudget, filter_error, train_filter
from torch_denkf.filters import Filter


@dataclass(frozen=True)
class Study(Recordings):
    """A real arm that its head camera watches: seven joints, with every filter that is registered.

    table: estimate the lag, train sensors and filters, test. diagnosis: how the trained sensors err. pictures: plots
    and videos of what a table left in --out. What was broken off goes on where it stopped. See benchmarks/g1/README.md.
    """

    command: Positional[Literal["table", "diagnosis", "pictures"]] = "table"
    filters: some_of(sorted(FILTERS)) = tuple(sorted(FILTERS))
    seeds: tuple[int, ...] = (0, 1, 2)
    sensor_budget: OmitArgPrefixes[SensorBudget] = field(default_factory=SensorBudget)
    budget: OmitArgPrefixes[FilterBudget] = field(default_factory=FilterBudget)
    smoke: bool = False  # a tiny run of everything, on a drawn robot


class Base:
    """Holds what all filters of a seed share.

    Args:
        study: the study.
        sensor: trained.
    """

    def __init__(self, study: Study, sensor: TrainedSensor):
        self.study, self.trained = study, sensor
        self.name = f"arm-{sensor.name}"
        self._motions: dict[bool, Motion] = {}

    @cached_property
    def sequences(self) -> list[tuple[Tensor, Tensor]]:
        """True states and commands of the sensor's and the filters' training episodes."""
        data, roles = self.study.data, self.trained.roles
        command = data.storage[:]["action"][:, list(ARM)]
        rows = [rows_of(data, [number]) for number in (*roles.sensor, *roles.tune)]
        return [(self.trained.target[at][:, :JOINTS], command[at]) for at in rows]

    @property
    def start(self) -> Tensor:
        """Returns where the training episodes begin, ``[N, D]``."""
        return torch.stack([state[0] for state, _ in self.sequences])

    def _pictures(self, role: str) -> dict[str, TensorDict]:
        """Returns what the sensor reads of the episodes of a role in all pictures; encodings as they are."""
        trained, study = self.trained, self.study
        sensors, _ = trained.trained
        numbers, out = getattr(trained.roles, role), {}
        for condition in PICTURES:
            file = study.out / "codes" / f"{trained.name}-{role}-{condition}.pt"
            exact = role == "test"
            hand = None if file.exists() else trained.hand
            codes = read_codes(sensors, study.data, hand, numbers, condition=condition, exact=exact, file=file)
            out[condition] = with_readings(sensors, codes, MEMBERS, self.start.mean(0))
        return out

    @cached_property
    def _tune(self) -> dict[str, TensorDict]:
        return self._pictures("tune")

    @cached_property
    def _encoding(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the encodings of the tuning episodes, in all pictures."""
        seen = torch.cat([one["sensor", "encoding"][one["observed"].squeeze(-1)] for one in self._tune.values()])
        return seen.mean(0), seen.std(0).clamp_min(1e-3)

    def _standardised(self, readings: TensorDict) -> TensorDict:
        sensor = readings["sensor"].copy()
        sensor["encoding"] = standardised(sensor["encoding"], *self._encoding)
        return readings.copy().set("sensor", sensor)

    def _readings(self, role: str) -> dict[str, TensorDict]:
        """Returns what the sensor reads of the episodes of a role, in all conditions."""
        pictures = self._tune if role == "tune" else self._pictures(role)
        out = {condition: self._standardised(one) for condition, one in pictures.items()}
        for condition in set(CONDITIONS) - set(PICTURES):
            out[condition] = fail(out["clean"], condition, self.black)
        return {condition: out[condition] for condition in CONDITIONS}

    @cached_property
    def black(self) -> TensorDict:
        """The reading of a black frame."""
        black = black_readings(self.trained.trained[0], MEMBERS)
        return black.set("encoding", standardised(black["encoding"], *self._encoding))

    @cached_property
    def tune(self) -> dict[str, TensorDict]:
        """Readings that filters are trained on."""
        return self._readings("tune")

    @cached_property
    def validation(self) -> dict[str, TensorDict]:
        """Readings to choose by."""
        return self._readings("validation")

    @cached_property
    def test(self) -> dict[str, TensorDict]:
        """Readings of the test episodes."""
        return self._readings("test")

    @cached_property
    def baselines(self) -> Baselines:
        """All baselines."""
        return Baselines([state for state, _ in self.sequences], self.tune, self.validation)

    def motion(self, actions: bool) -> Motion:
        """The motion, trained once on true states."""
        if actions not in self._motions:
            seed, study = self.trained.seed, self.study
            torch.manual_seed(seed)
            motion = Motion(self.trained.trained[1], actions)
            out = study.out / "motions" / f"arm{'-actions' * actions}-{seed}"
            self._motions[actions] = train_motion(
                motion, self.sequences, out=out, seed=seed, updates=study.budget.motion
            )
        return self._motions[actions]

    @cached_property
    def error(self) -> Tensor:
        """Root mean square error of the sensor on clean validation episodes, ``[D]``."""
        clean = self.validation["clean"]
        at = clean["observed"].squeeze(-1)
        return (clean["sensor", "ensemble"].mean(-2) - clean["state"])[at].square().mean(0).sqrt().clamp_min(1e-4)

    def train(self, name: str) -> tuple[G1Recipe, Filter]:
        """Trains a filter, or reads it."""
        kind = FILTERS[name]
        sensors, facts = self.trained.trained
        encoding = encoding_size(sensors)
        recipe = kind(
            facts,
            self.motion(kind.actions),
            self.error,
            self.start.std(0).clamp_min(1e-3),
            encoding,
            self.baselines.spread.noise,
        )
        windows = Windows(self.tune, self.black, self.study.budget.length)
        out = self.study.out / "filters" / f"{name}-{self.name}"
        model = train_filter(
            recipe, windows, joined(self.validation), out=out, seed=self.trained.seed, budget=self.study.budget
        )
        return recipe, model


def joined(readings: dict[str, TensorDict]) -> TensorDict:
    """Readings of all conditions as one batch."""
    return torch.cat(list(readings.values()))


def run_all(study: Study) -> None:
    """Trains and tests what is not done already; leaves rows in ``--out/rows``."""
    for seed in study.seeds:
        base, folder = Base(study, TrainedSensor(study, seed, study.sensor_budget)), study.out / "rows"
        once(folder / f"baselines-{base.name}.json", partial(_baselines, base, {"seed": seed}))
        for name in study.filters:
            once(folder / f"{name}-{base.name}.json", partial(_filter, base, {"seed": seed, "filter": name}))


def _baselines(base: Base, names: dict) -> list[dict]:
    return baseline_rows(base.baselines, base.test, names)


def _filter(base: Base, names: dict) -> list[dict]:
    _, model = base.train(names["filter"])
    rows = filter_rows(model, base.test, names)
    rows[0]["validation_crps"] = filter_error(model, joined(base.validation))["crps"]
    if names["filter"] == "denkf":
        save_beliefs(model, base.test, base.trained.roles.test, f"denkf-{base.name}", base.study.out / "beliefs")
    return rows


def rows_in(out: Path) -> list[dict]:
    """All rows that a study's folder holds."""
    return read_rows(sorted((out / "rows").glob("*.json")))
