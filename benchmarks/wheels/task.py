"""A robot on wheels: a gyro at 100 Hz, wheels at 20 Hz, GPS at 1 Hz, and two biases."""

from __future__ import annotations

from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf import FusedFilter
from torch_denkf.fusion import FusedSensor
from torch_denkf.modules import (
    EnsembleAnalysis,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    MomentPrior,
    Select,
)

__all__ = ["NAMES", "DT", "ensemble_filter", "gaussian_filter", "recordings"]

DT = 0.01  # s
NAMES = ("x", "y", "heading", "speed", "turn rate", "gyro bias", "wheel scale")
#: Standard deviations of the process noise of one step and of the initial state: m, m, rad, m/s, rad/s, rad/s, 1.
PROCESS = [0.0, 0.0, 0.0, 0.05, 0.05, 1e-4, 1e-5]
MEAN, STD = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0], [0.5, 0.5, 0.1, 0.3, 0.1, 0.02, 0.05]
#: Standard deviations of the readings, and steps between two.
GYRO, WHEELS, GPS = (0.01, 1), (0.05, 5), (0.5, 100)


def moved(state: Tensor) -> Tensor:
    """Returns the next states ``[*, 7]`` of a unicycle whose speed decays to 1 m/s and turn rate to zero."""
    x, y, heading, speed, turn, bias, scale = state.unbind(-1)
    place = x + DT * speed * heading.cos(), y + DT * speed * heading.sin(), heading + DT * turn
    return torch.stack([*place, speed + 0.2 * DT * (1 - speed), turn - 0.2 * DT * turn, bias, scale], -1)


def turn_rate(state: Tensor) -> Tensor:
    """Returns the gyro's reading, with its bias."""
    return state[..., 4:5] + state[..., 5:6]


def wheel_speed(state: Tensor) -> Tensor:
    """Returns the wheels' reading, with their scale."""
    return state[..., 3:4] * state[..., 6:7]


def recordings(runs: int, steps: int, seed: int) -> TensorDict:
    """Returns true states ``[runs, steps, 7]``, readings and their masks."""
    generator = torch.Generator().manual_seed(seed)
    draw = partial(torch.randn, generator=generator)
    state, states = torch.tensor(MEAN) + torch.tensor(STD) * draw(runs, 7), []
    for _ in range(steps):
        state = moved(state) + torch.tensor(PROCESS) * draw(runs, 7)
        states.append(state)
    data = TensorDict({"state": torch.stack(states, 1)}, [runs, steps])
    truths = {"gyro": turn_rate(data["state"]), "wheels": wheel_speed(data["state"]), "gps": data["state"][..., :2]}
    for (name, truth), (std, every) in zip(truths.items(), (GYRO, WHEELS, GPS), strict=True):
        data[name] = truth + std * draw(truth.shape)
        data[f"{name}_observed"] = (torch.arange(1, steps + 1) % every == 0).reshape(1, -1, 1).expand(runs, -1, 1)
    return data


def _sensors() -> dict[str, FusedSensor]:
    return {
        "gyro": FusedSensor(LearnedObservation(turn_rate), [GYRO[0]]),
        "wheels": FusedSensor(LearnedObservation(wheel_speed), [WHEELS[0]]),
        "gps": FusedSensor(Select([0, 1]), [GPS[0]] * 2),
    }


def ensemble_filter(members: int, **options) -> FusedFilter:
    """Returns an ensemble filter with square-root updates, sensor by sensor; ``options`` of its analyses."""
    return FusedFilter(
        LearnedTransition(moved, residual=False),
        _sensors(),
        initial=GaussianPrior(MEAN, STD, ensemble_size=members),
        process_noise=PROCESS,
        analysis=partial(EnsembleAnalysis, "etkf", **options),
    )


def gaussian_filter() -> FusedFilter:
    """Returns the extended Kalman filter."""
    return FusedFilter(
        LearnedTransition(moved, residual=False),
        _sensors(),
        initial=MomentPrior(torch.tensor(MEAN), torch.tensor(STD).square().diag()),
        process_noise=PROCESS,
    )
