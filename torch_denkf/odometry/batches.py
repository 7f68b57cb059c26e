"""Batches for the training of a car filter, what is minimised on them, and what is measured on whole drives."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.data import steps_between
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble, crps_gaussian
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import FlowSensor
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.odometry.car import VELOCITIES, CarFilter
from torch_denkf.odometry.streams import Drive, all_frames, lose_frames, mirror, read_sensor, rows, take_spans

__all__ = [
    "EndToEndLoss",
    "PairSampler",
    "ReadingSampler",
    "SensorLoss",
    "belief_error",
    "belief_loss",
    "calibrate",
    "filter_readings",
    "gain_of",
    "sensor_error",
]

INFLATIONS = (1.0, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4)
_GROUPS = 8  # drives in a batch of the sensor, windows in one of the whole filter


class PairSampler:
    """Draws pairs of frames, or windows, of drives themselves: for training that involves the sensor.

    Args:
        drives: that are drawn from, by their weights.
        data: of each, ``[N]``.
        longest: steps between the two frames of a pair, at most.
    """

    def __init__(self, drives: Sequence[Drive], data: Sequence[TensorDict], longest: int):
        self.data, self.longest = list(data), longest
        self.weight = torch.tensor([drive.weight for drive in drives])
        self.neighbours = torch.tensor([drive.steps == 1 for drive in drives])

    def frames(self, generator: torch.Generator, batch: int = 64) -> TensorDict:
        """Frames ``[batch]``, every second group of them mirrored."""
        chosen: list[TensorDict] = []
        for number in torch.multinomial(self.weight, _GROUPS, replacement=True, generator=generator).tolist():
            data = self.data[number]
            index = torch.randint(1, len(data), (batch // _GROUPS,), generator=generator)
            frames = rows(data, index, self.longest)
            chosen.append(mirror(frames) if len(chosen) % 2 else frames)
        return TensorDict.cat(chosen)

    def windows(self, generator: torch.Generator, length: int | None, start_std: Tensor) -> TensorDict:
        """Windows ``[8, length]`` that start from a wrong velocity."""
        weight = self.weight * self.neighbours
        chosen: list[TensorDict] = []
        for number in torch.multinomial(weight, _GROUPS, replacement=True, generator=generator).tolist():
            data = self.data[number]
            if length is None or len(data) <= length:
                raise ValueError(f"windows of {length} frames do not fit in a drive of {len(data)}; pass longer drives")
            first = int(torch.randint(1, len(data) - length + 1, (), generator=generator))
            frames = rows(data, torch.arange(first, first + length), self.longest)
            chosen.append(mirror(frames) if len(chosen) % 2 else frames)
        return _with_start(TensorDict.stack(chosen), start_std, generator)


class ReadingSampler:
    """Draws windows of a frozen sensor's readings.

    Args:
        readings: of each drive, ``[N]``, see :func:`torch_denkf.odometry.streams.read_spans`.
        weights: shares of the batches.
        length: steps of a window.
        gain_error: standard deviation of the logarithm of a factor on all speeds that a window's sensor reads: cameras
            are mounted a little higher or lower, or look a little further up, and the sensor cannot know.

    Raises:
        ValueError: if no drive is as long as a window.
    """

    def __init__(self, readings: Sequence[TensorDict], weights: Sequence[float], length: int, gain_error: float):
        self.readings, self.length, self.gain_error = TensorDict.cat(list(readings)), length, gain_error
        starts, weight, offset = [], [], 0
        for reading, share in zip(readings, weights, strict=True):
            count = len(reading) - length
            if count > 0:  # row 0 has no reading
                starts.append(offset + 1 + torch.arange(count))
                weight.append(torch.full((count,), share / count))
            offset += len(reading)
        if not starts:
            frames = [len(reading) for reading in readings]
            raise ValueError(
                f"windows of {length} steps do not fit in drives of {max(frames)} frames; pass longer drives or a "
                "smaller length"
            )
        self.starts, self.weight = torch.cat(starts), torch.cat(weight)

    def windows(self, generator: torch.Generator, start_std: Tensor, batch: int = 48) -> TensorDict:
        """Windows ``[batch, length]``, faster or slower than they were, of which up to half of the frames are lost."""
        start = self.starts[torch.multinomial(self.weight, batch, replacement=True, generator=generator)]
        windows = self.readings[start.unsqueeze(-1) + torch.arange(self.length)]
        # Few drives have few speeds, and the transition would learn to return to those.
        low, high = torch.tensor([-1.0, -0.7]), torch.tensor([0.7, 0.7])
        speed = (low + (high - low) * torch.rand(batch, 1, 2, generator=generator)).exp()
        gain = (self.gain_error * torch.tensor([1.0, 0.3]) * torch.randn(batch, 1, 2, generator=generator)).exp()
        share = 0.5 * torch.rand(batch, 1, generator=generator)
        kept = torch.rand(batch, self.length + 1, generator=generator) >= share
        longest = self.readings["spans"].shape[-1]
        windows = take_spans(windows, steps_between(kept, longest)[:, 1:])
        windows["state"][..., VELOCITIES] *= speed
        windows["sensor", "ensemble"] *= (speed * gain).unsqueeze(-2)
        return _with_start(windows, start_std, generator)


def _with_start(windows: TensorDict, start_std: Tensor, generator: torch.Generator) -> TensorDict:
    """Windows that begin at a wrong velocity: a filter that begins at the truth learns to hold on to it."""
    windows["start"] = windows["state"] + start_std * torch.randn(len(windows), 1, 5, generator=generator)
    return _mark_start(windows)


def _mark_start(windows: TensorDict) -> TensorDict:
    is_init = torch.zeros(*windows.batch_size, 1, dtype=torch.bool)
    is_init[..., 0, :] = True
    return windows.set("is_init", is_init)


# -------------------------------------------------------------------------------------------------- what is minimised


class SensorLoss(nn.Module):
    """CRPS of the sensor's samples against the true velocities, in units of a good sensor's errors."""

    unit: Tensor

    def __init__(self, sensor: FlowSensor, unit: Tensor):
        super().__init__()
        self.sensor = sensor
        self.register_buffer("unit", unit)

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """Scores frames ``[*B]``; the terms are losses of v and of theta_dot."""
        samples = self.sensor(frames)["sensor", "ensemble"]
        score = crps_ensemble(samples, frames["target_observation"]) / self.unit
        v, theta_dot = score[frames["observed"].squeeze(-1)].mean(0)
        return {"loss_v": v, "loss_theta_dot": theta_dot}


def belief_loss(model: Filter, unit: Tensor) -> DEnKFLoss:
    """CRPS of belief and forecast, in units of a good sensor's errors; the pose follows from the velocities."""
    scale = torch.cat([torch.full((3,), torch.inf), unit])
    share = len(VELOCITIES) / len(scale)  # a score is the mean over what counts: two of five
    return DEnKFLoss(model, state=share, transition=share, sensor=0.0, state_scale=scale)


class EndToEndLoss(nn.Module):
    """The filter's loss, and the sensor's own beside it."""

    def __init__(self, belief: nn.Module, sensor: SensorLoss):
        super().__init__()
        self.belief, self.sensor = belief, sensor

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """All terms."""
        own = {f"loss_sensor_{name[5:]}": 0.5 * value for name, value in self.sensor(frames.copy()).items()}
        return {**self.belief(frames), **own}


# ------------------------------------------------------------------------------------- what is measured on whole drives


def sensor_error(sensor: FlowSensor, drives: Sequence[TensorDict], unit: Tensor, longest: int) -> dict[str, float]:
    """CRPS of a sensor where it observes, mean of v and theta_dot in units of a good sensor's errors."""
    scores = []
    for data in drives:
        read = read_sensor(sensor, data, longest)
        score = (crps_ensemble(read["sensor", "ensemble"], read["target_observation"]) / unit.cpu()).mean(-1)
        scores.append(score[read["observed"].squeeze(-1)].mean())
    return {"crps": float(torch.stack(scores).mean())}


def gain_of(readings: TensorDict) -> Tensor:
    """Logarithm of how many times too far a sensor's readings of a whole drive lead."""
    drive = all_frames(readings)[1:]
    read, driven = drive["sensor", "ensemble"].mean(-2)[..., 0], drive["state"][..., 3]
    return (read.sum() / driven.sum()).clamp(0.5, 2.0).log()


@torch.no_grad()
def filter_readings(car: CarFilter, readings: Sequence[TensorDict], *, seed: int = 0) -> TensorDict:
    """Filters readings of one length side by side, ``[K, N]``.

    Each begins at its true pose, with the velocities of its first reading.

    Args:
        car: the filter.
        readings: each ``[N]``, see :func:`torch_denkf.odometry.streams.take_spans`.
        seed: of the filter's noise.
    """
    batch = TensorDict.stack([reading.copy() for reading in readings])
    batch["start"] = batch["state"].clone()
    batch["start"][:, 0] = torch.stack([first_state(reading) for reading in readings])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        device = next(car.parameters()).device
        return car.without_sensor().sequence(_mark_start(batch).to(device)).cpu()


def first_state(reading: TensorDict) -> Tensor:
    """The true first pose and the first velocities that the sensor reads, ``[5]``; zero where it reads none."""
    start = reading["state"][0].clone()
    seen = reading["observed"].squeeze(-1).nonzero()
    row = int(seen[0]) if len(seen) else 0
    steps = max(int(reading["steps"][row]), 1)
    start[VELOCITIES] = reading["sensor", "ensemble"][row].mean(0) / steps if len(seen) else torch.zeros(2)
    return start


def belief_error(car: CarFilter, readings: Sequence[TensorDict]) -> dict[str, float]:
    """CRPS of the belief's (v, theta_dot), in units of a good sensor's errors, with and without missing frames."""
    scores = [(crps_gaussian(*_velocities(out)) / car.settings.unit).mean((1, 2)) for out in _all(car, readings)]
    return {"crps": float(torch.cat(scores).mean())}


def calibrate(car: CarFilter, readings: Sequence[TensorDict], level: float = 0.9) -> float:
    """The inflation with which the filter's intervals come closest to holding their share of the truth.

    The filter's own inflation stays as it is.
    """
    before, distance = car.inflation, {}
    for inflation in INFLATIONS:
        car.inflation = inflation
        covered = [interval_coverage(*map(_flat, _velocities(out)), level=level) for out in _all(car, readings)]
        distance[inflation] = float((torch.stack(covered).mean(0) - level).abs().sum())
    car.inflation = before
    return min(distance, key=lambda inflation: distance[inflation])


def _all(car: CarFilter, readings: Sequence[TensorDict]) -> list[TensorDict]:
    """Beliefs on each reading as it is and with missing frames; those of one length side by side, ``[K, N]``."""
    groups: dict[int, list[TensorDict]] = defaultdict(list)
    for seed, reading in enumerate(readings):
        groups[len(reading)] += [all_frames(reading), lose_frames(reading, seed)]
    return [filter_readings(car, group) for group in groups.values()]


def _velocities(out: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
    """Means and variances of the belief's (v, theta_dot), and the truth ``[*K, N - 1, 2]``: the first row is given."""
    values = out["belief", "mean"], out["belief", "var"], out["state"]
    mean, variance, truth = (value[..., 1:, VELOCITIES] for value in values)
    return mean, variance.clamp_min(1e-8), truth


def _flat(value: Tensor) -> Tensor:
    return value.flatten(0, -2)
