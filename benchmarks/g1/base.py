"""Holds what all filters of a seed share: sensor, statistics, the hand's place."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.g1.aim import HandPlace
from benchmarks.g1.recordings import ARM, Recordings, Roles, bytes_of, rows_of, targets
from benchmarks.g1.sensors import FramePool, Statistics, build_sensor, train_sensor
from torch_denkf.modules import ImageSensor
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

CHECKED = 1200  # frames that a sensor is validated on


@dataclass(frozen=True)
class SensorBudget:
    """Updates of a sensor, and frames in each; networks that read together, trained from different random numbers."""

    updates: int = 2400
    frames: int = 32
    networks: int = 2


class TrainedSensor:
    """A sensor and what belongs to it.

    Args:
        recordings: the study's.
        seed: of roles and of all random numbers.
        budget: updates.
    """

    def __init__(self, recordings: Recordings, seed: int, budget: SensorBudget):
        self.recordings, self.seed, self.budget = recordings, seed, budget
        self.name = f"glimpse-{seed}"
        self.out = recordings.out / "sensors" / self.name

    @cached_property
    def roles(self) -> Roles:
        """Who trains, tunes, validates, is tested."""
        return self.recordings.roles(self.seed)

    @cached_property
    def target(self) -> Tensor:
        """True numbers of arm and hand, of all rows, ``[N, 13]``."""
        return targets(self.recordings.data.storage[:])

    def seen(self, numbers: list[int]) -> Tensor:
        """Rows of episodes that have a new picture."""
        rows = rows_of(self.recordings.data, numbers)
        return rows[self.recordings.data.storage[:]["observed"].squeeze(-1)[rows]]

    @cached_property
    def hand(self) -> HandPlace:
        """Returns the hand's place in the picture, of the arm's joints."""
        data = self.recordings.data
        return HandPlace(data, rows_of(data, self.roles.sensor), data.storage[:]["state"][:, list(ARM)])

    def pool(self, rows: Tensor) -> FramePool:
        """Frames of some rows."""
        target = self.target[rows]
        episode = self.recordings.data.storage[:]["episode"].flatten()[rows]
        return FramePool(bytes_of(self.recordings.data, rows), target, self.hand(target[:, : len(ARM)]), episode)

    @cached_property
    def trained(self) -> tuple[list[ImageSensor], Statistics]:
        """The trained networks. Their statistics lie beside them: a resumed study does not read the pictures."""
        folders, facts_file = [self.out / str(k) for k in range(self.budget.networks)], self.out / "facts.pt"
        if facts_file.exists() and all((folder / "sensor.pt").exists() for folder in folders):
            facts = Statistics(**read_checkpoint(facts_file))
            return [self._read(folder, facts) for folder in folders], facts
        data = self.recordings.data
        train = self.pool(self.seen(self.roles.sensor))
        checked = self.seen([*self.roles.tune, *self.roles.validation])
        held_out = self.pool(checked[:: max(len(checked) // CHECKED, 1)])
        facts = Statistics.of([self.target[rows_of(data, [number])] for number in self.roles.sensor], train.pixels)
        sensors = []
        for k, folder in enumerate(folders):
            seed = self.seed + 1000 * k
            torch.manual_seed(seed)
            sensor, budget = build_sensor(facts), {"updates": self.budget.updates, "batch": self.budget.frames}
            train_sensor(sensor, train, held_out, out=folder, seed=seed, **budget)
            sensors.append(sensor.eval())
        write_checkpoint(facts_file, vars(facts))
        return sensors, facts

    def _read(self, folder: Path, facts: Statistics) -> ImageSensor:
        sensor = build_sensor(facts)
        sensor.load_state_dict(read_checkpoint(folder / "sensor.pt")["sensor"])
        return sensor.eval()
