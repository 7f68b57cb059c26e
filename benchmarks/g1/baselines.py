"""Baselines without a filter: the mean pose, the sensor alone, and its last reading."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arm import JOINTS
from benchmarks.common.arm.scores import estimated
from benchmarks.common.training import random_rows
from benchmarks.g1.recipes import SPREAD_CELLS
from torch_denkf.functional import crps_gaussian
from torch_denkf.modules import DiagonalNoise
from torch_denkf.training import Stage, hold_last
from torch_denkf.training.parts import train_part


def seen_pairs(readings: Sequence[TensorDict]) -> TensorDict:
    """Returns encodings and errors of all observed frames, ``[M]``."""
    parts = torch.cat([one[one["observed"].squeeze(-1)] for one in readings])
    error = parts["sensor", "ensemble"].mean(-2) - parts["state"]
    return TensorDict({"encoding": parts["sensor", "encoding"], "error": error}, parts.shape)


class SensorSpread:
    """Model of the variance of a sensor's error given its encoding, fitted on the tuning episodes.

    The spread of a sensor's samples comes from the noise of its weights, and underestimates its error on new episodes.

    Args:
        tune: readings of the tuning episodes, under all image conditions.
        validation: of the validation episodes, for early stopping and a factor for the coverage.
        out: folder of the fit.
        updates: of the fit.
    """

    def __init__(self, tune: Sequence[TensorDict], validation: Sequence[TensorDict], out: Path, updates: int):
        pairs, checked = seen_pairs(tune), seen_pairs(validation)
        root = pairs["error"].square().mean(0).sqrt().clamp_min(1e-4)
        options = {"num_cells": SPREAD_CELLS, "in_features": pairs["encoding"].shape[-1], "in_key": "encoding"}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.noise = DiagonalNoise(JOINTS, r=root, **options)

        def crps(some: TensorDict) -> Tensor:
            variance = self._variance(some["encoding"])
            return crps_gaussian(torch.zeros_like(variance), variance, some["error"])

        loss = lambda some: {"loss_crps": (crps(some) / root).mean()}  # noqa: E731
        stage = Stage("spread", loss, random_rows(pairs, 1024), updates, lr=5e-4, weight_decay=0.1, schedule="constant")
        settings = {"monitor": "crps", "validate_every": 20, "loggers": (), "device": "cpu", "seed": 0}
        train_part(self.noise, stage, out=out, validate=lambda: {"crps": float(crps(checked).mean())}, **settings)
        with torch.no_grad():
            away = checked["error"].abs() / self._variance(checked["encoding"]).sqrt()
        self.factor = float(away.flatten().quantile(0.9)) / 1.645

    def _variance(self, features: Tensor) -> Tensor:
        return self.noise(TensorDict({"encoding": features}, batch_size=[len(features)]))["sensor", "noise"]

    @torch.no_grad()
    def __call__(self, readings: TensorDict) -> Tensor:
        """Returns variances ``[N, T, D]``."""
        features = readings["sensor", "encoding"]
        return self.factor**2 * self._variance(features.flatten(0, 1)).unflatten(0, features.shape[:2])


def baselines(readings: TensorDict, sequences: Sequence[Tensor], spread: SensorSpread) -> dict[str, TensorDict]:
    """Returns beliefs ``[N, T]`` of all baselines, by name.

    Args:
        readings: of the sensor.
        sequences: true states of the training episodes, ``[T, D]`` each.
        spread: of the sensor.
    """
    flat, start = torch.cat(list(sequences)), torch.stack([one[0] for one in sequences]).mean(0)
    truth, seen, there = readings["state"], readings["observed"], readings["arrived"]
    mean, var = (value.expand_as(truth) for value in (flat.mean(0), flat.var(0)))
    read, read_var = readings["sensor", "ensemble"].mean(-2), spread(readings)
    held = hold_last(read, seen, start.expand_as(truth[:, 0])), hold_last(read_var, seen, var[:, 0])
    # Without an image the sensor alone falls back to the mean pose.
    alone = torch.where(there, read, mean), torch.where(there, read_var, var)
    found = {"mean_pose": (mean, var), "sensor": alone, "held": held}
    return {name: estimated(readings, *moments) for name, moments in found.items()}
