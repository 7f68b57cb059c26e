"""Loss of a car filter, and its scores on whole drives."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.applications.car.modules.flow_sensor import FlowSensor
from torch_denkf.applications.car.odometry.batches import mark_start
from torch_denkf.applications.car.odometry.filter import VELOCITIES, CarFilter
from torch_denkf.applications.car.odometry.streams import all_frames, lose_frames, read_sensor
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble, crps_gaussian
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.training import choose

__all__ = [
    "EndToEndLoss",
    "SensorLoss",
    "belief_error",
    "belief_loss",
    "calibrate",
    "filter_readings",
    "first_state",
    "gain_of",
    "sensor_error",
]

INFLATIONS = (1.0, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4)


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
    """Returns the CRPS of belief and forecast, in units of a good sensor's errors; poses have no term."""
    scale = torch.cat([torch.full((3,), torch.inf), unit])
    share = len(VELOCITIES) / len(scale)  # the mean over five components has two that count
    return DEnKFLoss(model, state=share, transition=share, sensor=0.0, state_scale=scale)


class EndToEndLoss(nn.Module):
    """Adds the sensor's loss to the filter's loss."""

    def __init__(self, belief: nn.Module, sensor: SensorLoss):
        super().__init__()
        self.belief, self.sensor = belief, sensor

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """Returns all terms."""
        own = {f"loss_sensor_{name[5:]}": 0.5 * value for name, value in self.sensor(frames.copy()).items()}
        return {**self.belief(frames), **own}


# ------------------------------------------------------------------------------------- scores on whole drives


def sensor_error(sensor: FlowSensor, drives: Sequence[TensorDict], unit: Tensor, longest: int) -> dict[str, float]:
    """Returns the CRPS of a sensor on observed frames, mean of v and theta_dot in units of a good sensor's errors."""
    scores = []
    for data in drives:
        read = read_sensor(sensor, data, longest)
        score = (crps_ensemble(read["sensor", "ensemble"], read["target_observation"]) / unit.cpu()).mean(-1)
        scores.append(score[read["observed"].squeeze(-1)].mean())
    return {"crps": float(torch.stack(scores).mean())}


def gain_of(readings: TensorDict) -> Tensor:
    """Returns the logarithm of a sensor's gain on a whole drive: distance by its readings over true distance."""
    drive = all_frames(readings)[1:]
    read, driven = drive["sensor", "ensemble"].mean(-2)[..., 0], drive["state"][..., 3]
    return (read.sum() / driven.sum()).clamp(0.5, 2.0).log()


@torch.no_grad()
def filter_readings(car: CarFilter, readings: Sequence[TensorDict], *, seed: int = 0) -> TensorDict:
    """Filters readings of equal length in one batch, ``[K, N]``.

    Each run begins at the true pose, with the velocities of the first reading.

    Args:
        car: the filter.
        readings: each ``[N]``, see :func:`torch_denkf.applications.car.odometry.streams.take_spans`.
        seed: seed of the filter's noise.
    """
    batch = TensorDict.stack([reading.copy() for reading in readings])
    batch["start"] = batch["state"].clone()
    batch["start"][:, 0] = torch.stack([first_state(reading) for reading in readings])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        device = next(car.parameters()).device
        return car.without_sensor().sequence(mark_start(batch).to(device)).cpu()


def first_state(reading: TensorDict) -> Tensor:
    """Returns the true first pose and the first reading of the velocities, ``[5]``; zeros without a reading."""
    start = reading["state"][0].clone()
    seen = reading["observed"].squeeze(-1).nonzero()
    row = int(seen[0]) if len(seen) else 0
    steps = max(int(reading["steps"][row]), 1)
    start[VELOCITIES] = reading["sensor", "ensemble"][row].mean(0) / steps if len(seen) else torch.zeros(2)
    return start


def belief_error(car: CarFilter, readings: Sequence[TensorDict]) -> dict[str, float]:
    """Returns the CRPS of (v, theta_dot), in units of a good sensor's errors, with and without missing frames."""
    return {"crps": _crps(car, _all(car, readings))}


def calibrate(car: CarFilter, readings: Sequence[TensorDict]) -> float:
    """Returns the inflation with the least product of the velocities' CRPS and the path error.

    Coverage of the velocities alone would choose an inflation with a larger path error, which no reading corrects. The
    filter's inflation is unchanged.
    """

    def error() -> float:
        runs = _all(car, readings)
        apart = [(out["belief", "mean"][..., :2] - out["state"][..., :2]).norm(dim=-1).mean(1) for out in runs]
        return _crps(car, runs) * float(torch.cat(apart).mean())

    before = car.inflation
    best = choose(INFLATIONS, lambda inflation: setattr(car, "inflation", inflation), error)
    car.inflation = before
    return best


def _crps(car: CarFilter, runs: Sequence[TensorDict]) -> float:
    scores = [(crps_gaussian(*_velocities(out)) / car.settings.unit).mean((1, 2)) for out in runs]
    return float(torch.cat(scores).mean())


def _all(car: CarFilter, readings: Sequence[TensorDict]) -> list[TensorDict]:
    """Filters each reading as recorded and with missing frames, in batches of equal length ``[K, N]``."""
    groups: dict[int, list[TensorDict]] = defaultdict(list)
    for seed, reading in enumerate(readings):
        groups[len(reading)] += [all_frames(reading), lose_frames(reading, seed)]
    return [filter_readings(car, group) for group in groups.values()]


def _velocities(out: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
    """Returns means and variances of (v, theta_dot), and the truth ``[*K, N - 1, 2]``, without the first row."""
    values = out["belief", "mean"], out["belief", "var"], out["state"]
    mean, variance, truth = (value[..., 1:, VELOCITIES] for value in values)
    return mean, variance.clamp_min(1e-8), truth
