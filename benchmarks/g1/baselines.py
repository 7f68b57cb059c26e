"""Estimates without a filter: do the pictures say anything, and does a filter say more than its sensor?"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.g1.readings import PICTURES
from benchmarks.g1.recordings import JOINTS
from torch_denkf.functional import crps_gaussian
from torch_denkf.modules import DiagonalNoise
from torch_denkf.training import hold_last

SPREAD_CELLS = (16,)  # hidden layers of the sensor's spread


class SensorSpread:
    """The variance of a sensor's error, from what it saw: fitted on the tuning episodes, in all conditions.

    A sensor's samples say how its weights' noise spreads, not how wrong it is on episodes it has not seen.

    Args:
        tune: readings of the tuning episodes, by condition.
        validation: of the validation episodes; they choose when to stop, and a factor for the coverage.
        updates: of the fit.
    """

    def __init__(
        self,
        tune: dict[str, TensorDict],
        validation: dict[str, TensorDict],
        updates: int = 600,
    ):
        features, error = _pairs([tune[name] for name in PICTURES])
        checked, wrong = _pairs([validation[name] for name in PICTURES])
        root = error.square().mean(0).sqrt().clamp_min(1e-4)
        options = {"num_cells": SPREAD_CELLS, "in_features": features.shape[-1], "in_key": "encoding"}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.noise = DiagonalNoise(JOINTS, r=root, **options)
            optimiser = torch.optim.AdamW(self.noise.parameters(), lr=5e-4, weight_decay=0.1)
            best, kept = self._score(checked, wrong), deepcopy(self.noise.state_dict())
            for update in range(updates):
                index = torch.randint(len(error), (1024,))
                loss = (self._crps(features[index], error[index]) / root).mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.noise.parameters(), 1.0)
                optimiser.step()
                if update % 20 == 19 and self._score(checked, wrong) < best:
                    best, kept = self._score(checked, wrong), deepcopy(self.noise.state_dict())
            self.noise.load_state_dict(kept)
        with torch.no_grad():
            away = (wrong.abs() / self._variance(checked).sqrt()).flatten()
        self.factor = float(away.quantile(0.9)) / 1.645

    def _crps(self, features: Tensor, error: Tensor) -> Tensor:
        variance = self._variance(features)
        return crps_gaussian(torch.zeros_like(variance), variance, error)

    @torch.no_grad()
    def _score(self, features: Tensor, error: Tensor) -> float:
        return float(self._crps(features, error).mean())

    def _variance(self, features: Tensor) -> Tensor:
        return self.noise(TensorDict({"encoding": features}, batch_size=[len(features)]))["sensor", "noise"]

    @torch.no_grad()
    def __call__(self, readings: TensorDict) -> Tensor:
        """Variances ``[N, T, D]``."""
        features = readings["sensor", "encoding"]
        return self.factor**2 * self._variance(features.flatten(0, 1)).unflatten(0, features.shape[:2])


def _pairs(readings: Sequence[TensorDict]) -> tuple[Tensor, Tensor]:
    """Encodings and errors of all frames that are seen."""
    parts = [one[one["observed"].squeeze(-1)] for one in readings]
    features = torch.cat([part["sensor", "encoding"] for part in parts])
    truth = torch.cat([part["state"] for part in parts])
    return features, torch.cat([part["sensor", "ensemble"].mean(-2) for part in parts]) - truth


class Baselines:
    """All baselines.

    Args:
        sequences: true states of the training episodes, ``[T, D]`` each.
        tune: readings of the tuning episodes, by condition.
        validation: of the validation episodes, by condition, with those of failing frames.
    """

    names = ("mean_pose", "sensor", "held")

    def __init__(self, sequences: Sequence[Tensor], tune: dict[str, TensorDict], validation: dict[str, TensorDict]):
        flat = torch.cat(list(sequences))
        self.mean, self.var = flat.mean(0), flat.var(0)
        self.start = torch.stack([one[0] for one in sequences]).mean(0)
        self.spread = SensorSpread(tune, validation)

    def __call__(self, name: str, readings: TensorDict) -> tuple[Tensor, Tensor]:
        """Means and variances ``[N, T, D]``."""
        truth, seen = readings["state"], readings["observed"]
        if name == "mean_pose":
            return self.mean.expand_as(truth), self.var.expand_as(truth)
        read, var = readings["sensor", "ensemble"].mean(-2), self.spread(readings)
        if name == "held":
            first = self.var.expand_as(truth[:, 0])
            return hold_last(read, seen, self.start.expand_as(truth[:, 0])), hold_last(var, seen, first)
        if name == "sensor":  # it knows nothing where no picture arrives
            there = readings["arrived"]
            return torch.where(there, read, self.mean), torch.where(there, var, self.var)
        raise ValueError(f"there is no baseline {name!r}; there are {self.names}")
