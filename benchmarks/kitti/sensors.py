"""Sensors by name, and their training: alone, and by cross-fitting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.scores import SensorLoss
from benchmarks.kitti.folds import Fold, Part, Statistics, frame_sampler, statistics
from benchmarks.kitti.readings import read_sensor, read_spans
from torch_denkf.applications.car import FlowSensor
from torch_denkf.functional import crps_ensemble
from torch_denkf.modules import ImageSensor, SubModel, convolutional_trunk
from torch_denkf.training import Stage
from torch_denkf.training.parts import train_part

SAMPLES = 32  # of a sensor: as many as the ensemble filters have members


def flow_sensor(statistics: Statistics) -> SubModel:
    """Returns the sensor of optical flow, road correlation, and tracked corners for the turn."""
    return FlowSensor(dt=statistics.dt, ensemble_size=SAMPLES, two_view_key="two_view")


def image_sensor(statistics: Statistics) -> SubModel:
    """Returns the paper's sensor: Table I on a grey frame and its difference to the one before."""
    return ImageSensor(
        2,
        image_shape=(2, 50, 150),
        trunk=convolutional_trunk(2),
        ensemble_size=SAMPLES,
        loc=statistics.loc,
        scale=statistics.scale,
        pixel_loc=statistics.pixel_loc,
        pixel_scale=statistics.pixel_scale,
        encoding_key=("sensor", "encoding"),
    )


SENSORS: dict[str, Callable[[Statistics], SubModel]] = {"flow": flow_sensor, "image": image_sensor}


def sensor_loss(sensor: SubModel, unit: Tensor) -> SensorLoss:
    """Returns the CRPS of v and of theta_dot, in units of a good sensor's errors."""
    terms = {"loss_v": slice(0, 1), "loss_theta_dot": slice(1, 2)}
    return SensorLoss(sensor, lambda frames: frames["target_observation"], unit, terms)


@dataclass(frozen=True)
class SensorTraining:
    """Training of a study's sensors: alone, and by cross-fitting.

    Args:
        kind: name of the sensor.
        facts: statistics of the training drives.
        cache: of the streams.
        seed: of all random numbers.
    """

    kind: str
    facts: Statistics
    cache: Path
    seed: int

    def error(self, sensor: SubModel, parts: Sequence[Part]) -> dict[str, float]:
        """Returns the CRPS over observed rows, mean of v and theta_dot in units of a good sensor's errors."""
        scores = []
        for part in parts:
            read = read_sensor(sensor, part.read(self.cache), self.kind)
            score = (crps_ensemble(read["sensor", "ensemble"], read["target_observation"]) / self.facts.unit).mean(-1)
            scores.append(score[read["observed"].squeeze(-1)].mean())
        return {"crps": float(torch.stack(scores).mean())}

    def train(
        self, sensor: SubModel, parts: Sequence[Part], held_out: Sequence[Part], out: Path, updates: int, **settings
    ) -> SubModel:
        """Trains a sensor alone, or loads it if it was trained before; settings are ``lr`` and ``keep``."""
        sampler, loss = frame_sampler(parts, self.cache, self.kind), sensor_loss(sensor, self.facts.unit)
        rates = {"lr": settings.pop("lr", 2e-3), "weight_decay": 0.02}
        return train_part(
            sensor,
            Stage("sensor", loss, lambda generator, _: sampler.frames(generator), updates, **rates),
            out=out,
            validate=lambda: self.error(sensor, held_out),
            validate_every=max(updates // 4, 1),
            save_every=200,
            seed=self.seed,
            **settings,
        )

    def unseen_readings(
        self, sensor: SubModel, fold: Fold, out: Path, updates: int, lr: float
    ) -> list[tuple[TensorDict, TensorDict, float]]:
        """Returns readings of drives by sensors that were not trained on them (cross-fitting).

        A filter learns from its sensor's errors, which are smaller on drives that the sensor was trained on. So drives
        in both lists are read by two further sensors: each is trained on one half of those drives, and reads the other.

        Returns:
            for each part of the tuning drives, and mirrored: readings to tune with, readings to validate with, the
            weight.
        """
        shared = list(dict.fromkeys(p.stream.drive for p in fold.tune if p.stream.drive in fold.trained))
        readers = {}
        for half in (shared[0::2], shared[1::2]) if shared else ():
            parts = [part for part in fold.train if part.stream.drive not in half]
            held_out = [part for part in fold.tune if part.stream.drive in half]
            folder = out / ("without-" + "-".join(half))
            stand_in = self.train(deepcopy(sensor), parts, held_out, folder, updates, lr=lr, keep="last")
            readers |= dict.fromkeys(half, stand_in)
        result = []
        for part in fold.tune:
            for mirrored in (False, True):
                reader = readers.get(part.stream.drive, sensor)
                reading = read_spans(reader, part, self.cache, self.kind, mirrored)
                split = int(0.7 * len(reading))
                result.append((reading[:split], reading[split:], part.weight))
        return result


@dataclass
class SensorOfFold:
    """The trained sensor of a fold, which its filters share, and its readings of drives that it was not trained on."""

    kind: str
    sensor: SubModel
    facts: Statistics
    readings: list[tuple[TensorDict, TensorDict, float]]  # see SensorTraining.unseen_readings

    @property
    def validation(self) -> list[TensorDict]:
        """Returns the readings for validation, without the mirrored ones, which are redundant."""
        return [reading for _, reading, _ in self.readings[::2]]


def sensor_of_fold(
    fold: Fold,
    kind: str,
    *,
    out: Path,
    cache: Path,
    seed: int,
    updates: int,
    fine_tuning: int,
    pretrained: SubModel | None = None,
) -> SensorOfFold:
    """Trains a fold's sensor, or loads it if it was trained before.

    Args:
        fold: drives for training, tuning and validation.
        kind: name of the sensor.
        out: folder for checkpoints and logs.
        cache: of the streams.
        seed: of all random numbers.
        updates: of a sensor without pretraining.
        fine_tuning: updates of a ``pretrained`` sensor, and of the further sensors that read shared drives.
        pretrained: sensor whose parameters the training starts from.
    """
    torch.manual_seed(seed)
    facts = statistics(fold.train, cache)
    sensor, training = SENSORS[kind](facts), SensorTraining(kind, facts, cache, seed)
    settings, lr = {}, 2e-3
    if pretrained is not None:
        sensor.load_state_dict(pretrained.state_dict())
        settings, lr, updates = {"lr": 1e-3, "keep": "last"}, 1e-3, fine_tuning
    # The further sensors start from the same parameters, so they are trained before the sensor.
    read = training.unseen_readings(sensor, fold, out, updates, lr) if fold.shared else []
    training.train(sensor, fold.train, fold.validation, out / "sensor", updates, **settings)
    return SensorOfFold(kind, sensor, facts, read or training.unseen_readings(sensor, fold, out, 0, lr))
