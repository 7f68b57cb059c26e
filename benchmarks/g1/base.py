"""Inputs that all filters of a seed share: sensor, statistics, the hand's place, features of the images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arm import Roles
from benchmarks.common.arm.motion import with_rates
from benchmarks.common.arm.readings import read_codes
from benchmarks.common.arm.sensors import Statistics, train_sensor
from benchmarks.g1.aim import HandPlace
from benchmarks.g1.disturbances import failing
from benchmarks.g1.motion import delayed
from benchmarks.g1.recordings import ARM, Recordings, bytes_of, rows_of, targets
from benchmarks.g1.sensors import FrameLoss, FramePool, build_sensor
from torch_denkf.modules import ImageSensor
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

CHECKED = 1200  # frames that a sensor is validated on


@dataclass(frozen=True)
class SensorBudget:
    """Updates of a sensor, frames in each, and the number of its networks, which have different seeds."""

    updates: int = 2400
    frames: int = 32
    networks: int = 2


class TrainedSensor:
    """A sensor with its training data and its features.

    Args:
        recordings: the study's.
        seed: of roles and of all random numbers.
        budget: of the sensor's training.
    """

    def __init__(self, recordings: Recordings, seed: int, budget: SensorBudget):
        self.recordings, self.seed, self.budget = recordings, seed, budget
        self.name = f"glimpse-{seed}"
        self.out = recordings.out / "sensors" / self.name

    @cached_property
    def roles(self) -> Roles:
        """Returns the episodes for training, tuning, validation and test."""
        return self.recordings.roles(self.seed)

    @cached_property
    def hand(self) -> HandPlace:
        """Returns the regression of the hand's place in the image on the arm's joints."""
        data = self.recordings.data
        return HandPlace(data, rows_of(data, self.roles.sensor), data.storage[:]["state"][:, list(ARM)])

    def pool(self, numbers: list[int], most: int | None = None) -> FramePool:
        """Returns frames of episodes with a new image, at most about ``most``."""
        data, rows = self.recordings.data, rows_of(self.recordings.data, numbers)
        rows = rows[data.storage[:]["observed"].squeeze(-1)[rows]]
        rows = rows[:: max(len(rows) // most, 1)] if most else rows
        target, episode = targets(data.storage[:])[rows], data.storage[:]["episode"].flatten()[rows]
        return FramePool(bytes_of(data, rows), target, self.hand(target[:, : len(ARM)]), episode)

    @cached_property
    def trained(self) -> tuple[list[ImageSensor], Statistics]:
        """Returns the trained networks, with saved statistics, so that a resumed study reads no images."""
        folders, facts_file = [self.out / str(k) for k in range(self.budget.networks)], self.out / "facts.pt"
        done = facts_file.exists() and all((folder / "sensor.pt").exists() for folder in folders)
        train = held_out = None
        if done:
            facts = Statistics(**read_checkpoint(facts_file))
        else:
            data, roles = self.recordings.data, self.roles
            train, held_out = self.pool(roles.sensor), self.pool([*roles.tune, *roles.validation], CHECKED)
            true = targets(data.storage[:])
            facts = Statistics.of([true[rows_of(data, [number])] for number in roles.sensor], train.pixels)
        sensors = []
        for k, folder in enumerate(folders):
            seed = self.seed + 1000 * k
            torch.manual_seed(seed)
            sensor, sample = build_sensor(facts), lambda generator: train.sample(generator, self.budget.frames)
            settings = {"out": folder, "seed": seed, "updates": self.budget.updates, "lr": 2e-3, "weight_decay": 0.05}
            sensors.append(train_sensor(sensor, FrameLoss(sensor), sample, held_out, **settings))
        write_checkpoint(facts_file, vars(facts))
        return sensors, facts

    def codes(self, role: str, condition: str = "clean") -> TensorDict:
        """Returns features of a role's episodes ``[N, T]`` under a condition, with joints, rates and commands."""
        data, exact = self.recordings.data, role == "test"

        def see(rows: TensorDict) -> TensorDict:
            number = data.episodes[int(rows["episode"][0])].number
            draw = torch.rand(4, generator=torch.Generator().manual_seed(number))
            arm, action = (rows[key][:, list(ARM)] for key in ("state", "action"))
            pixels = failing(rows["pixels"], self.hand(arm), condition, draw, exact)
            seen = {"pixels": pixels, "observed": rows["observed"], "state": arm, "action": action}
            return TensorDict(seen, batch_size=rows.batch_size)

        sequences = [rows_of(data, [number]) for number in getattr(self.roles, role)]
        file = self.recordings.out / "codes" / f"{self.name}-{role}-{condition}.pt"
        codes = read_codes(self.trained[0], data, sequences, see, file)
        codes["motion"], codes["commands"] = with_rates(codes["state"], 1), codes["action"]
        return codes.set("action", delayed(codes["action"]))

    def sequences(self) -> list[tuple[Tensor, Tensor]]:
        """Returns true joints and commands of the sensor's and the filters' training episodes, ``[T, D]`` each."""
        data = self.recordings.data
        both = [data.storage[:][key][:, list(ARM)] for key in ("state", "action")]
        rows = [rows_of(data, [number]) for number in (*self.roles.sensor, *self.roles.tune)]
        return [(both[0][at], both[1][at]) for at in rows]
