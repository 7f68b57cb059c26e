"""What needs no filter: do the pictures say anything, and does a filter say more than its sensor?"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.g1.readings import PICTURES
from benchmarks.g1.scores import FLOOR, counted
from benchmarks.g1.targets import Target
from torch_denkf.functional import crps_gaussian
from torch_denkf.modules import DiagonalNoise
from torch_denkf.training import hold_last

BINS = 100  # of an episode's phase
SPREAD_CELLS = (16,)  # hidden layers of the sensor's spread
WEIGHTS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # of a new reading in an exponential filter


def clock(sequences: Sequence[Tensor], bins: int = BINS) -> tuple[Tensor, Tensor]:
    """Mean and variance of the episodes ``[T_k, D]`` at each share of their length, ``[bins, D]``."""
    at = torch.linspace(0, 1, bins)
    resampled = torch.stack([one[(at * (len(one) - 1)).round().long()] for one in sequences])
    return resampled.mean(0), resampled.var(0)


def at_phase(values: Tensor, lengths: Tensor, steps: int) -> Tensor:
    """Values of a clock ``[bins, D]`` in each row of episodes, ``[N, steps, D]``."""
    phase = torch.arange(steps) / (lengths.unsqueeze(-1) - 1).clamp_min(1)
    return values[(phase.clamp(max=1) * (len(values) - 1)).round().long()]


def smoothed(reading: Tensor, observed: Tensor, start: Tensor, weight: float) -> Tensor:
    """An exponential filter: the estimate moves by a share of the way to each reading that arrives.

    Args:
        reading: ``[N, T, D]``.
        observed: ``[N, T, 1]``.
        start: ``[D]`` or ``[N, D]``, before the first reading, which is taken as it is.
        weight: the share, in (0, 1].
    """
    estimate, out = start.expand_as(reading[:, 0]), []
    begun = torch.zeros_like(observed[:, 0])
    for now, seen in zip(reading.unbind(1), observed.unbind(1), strict=True):
        moved = torch.where(begun, estimate + weight * (now - estimate), now)
        estimate, begun = torch.where(seen, moved, estimate), begun | seen
        out.append(estimate)
    return torch.stack(out, 1)


class SensorSpread:
    """The variance of a sensor's error, from what it saw: fitted on the tuning episodes, in all conditions.

    A sensor's samples say how its weights' noise spreads, not how wrong it is on episodes it has not seen.

    Args:
        target: what is read.
        tune: readings of the tuning episodes, by condition.
        validation: of the validation episodes; they choose when to stop, and a factor for the coverage.
        updates: of the fit.
    """

    def __init__(
        self,
        target: Target,
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
            self.noise = DiagonalNoise(target.size, r=root, **options)
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
    """All baselines of a target.

    Args:
        target: what is estimated.
        sequences: true states of the training episodes, ``[T, D]`` each.
        tune: readings of the tuning episodes, by condition.
        validation: of the validation episodes, by condition, with those of failing frames.
    """

    names = ("mean_pose", "clock", "sensor", "held", "smoothed")

    def __init__(
        self,
        target: Target,
        sequences: Sequence[Tensor],
        tune: dict[str, TensorDict],
        validation: dict[str, TensorDict],
    ):
        flat = torch.cat(list(sequences))
        self.mean, self.var = flat.mean(0), flat.var(0)
        self.start = torch.stack([one[0] for one in sequences]).mean(0)
        self.clock, self.clock_var = clock(sequences)
        self.spread = SensorSpread(target, tune, validation)
        errors = {weight: self._validation_error(validation["clean"], weight) for weight in WEIGHTS}
        self.weight = min(errors, key=errors.__getitem__)
        residuals = []
        for reading in validation.values():
            mean = smoothed(_mean(reading), reading["observed"], self.start, self.weight)
            residuals.append((mean - reading["state"])[counted(reading)])
        self.smoothed_var = (torch.cat(residuals).abs().quantile(0.9, dim=0) / 1.645).square().clamp_min(FLOOR)

    def _validation_error(self, reading: TensorDict, weight: float) -> float:
        mean = smoothed(_mean(reading), reading["observed"], self.start, weight)
        return float((mean - reading["state"])[counted(reading)].abs().mean())

    def __call__(self, name: str, readings: TensorDict) -> tuple[Tensor, Tensor]:
        """Means and variances ``[N, T, D]``."""
        truth, seen = readings["state"], readings["observed"]
        if name == "mean_pose":
            return self.mean.expand_as(truth), self.var.expand_as(truth)
        if name == "clock":
            lengths = readings["valid"].sum((1, 2))
            return tuple(at_phase(value, lengths, truth.shape[1]) for value in (self.clock, self.clock_var))
        read = _mean(readings)
        if name == "smoothed":
            return smoothed(read, seen, self.start, self.weight), self.smoothed_var.expand_as(truth)
        var = self.spread(readings)
        if name == "held":
            first = self.var.expand_as(truth[:, 0])
            return hold_last(read, seen, self.start.expand_as(truth[:, 0])), hold_last(var, seen, first)
        if name == "sensor":  # it knows nothing where no picture arrives
            there = readings["arrived"]
            return torch.where(there, read, self.mean), torch.where(there, var, self.var)
        raise ValueError(f"there is no baseline {name!r}; there are {self.names}")


def _mean(readings: TensorDict) -> Tensor:
    return readings["sensor", "ensemble"].mean(-2)
