"""A cart with dry friction whose position readings have 20 % outliers; and a particle filter with the true model."""

from __future__ import annotations

import math
from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.functional.scores import crps_ensemble
from torch_denkf.modules import SubModel

__all__ = ["SHARE", "SKIP", "START", "WRONG", "ReadingNoise", "SpeedNoise", "best", "moved", "recordings"]

DT, STEPS, SKIP = 0.05, 40, 8  # s; steps of a run; steps that are not scored
SHARE, WRONG = 0.2, 2.0  # of outliers, and their standard deviation, m
START = [0.5, 0.5]  # standard deviations of position, m, and speed, m/s, at the start


def moved(driven: Tensor) -> Tensor:
    """Returns the next positions and speeds ``[*, 2]`` from positions, speeds and drives ``[*, 3]``.

    The cart has dry friction and drag; it sticks below 0.05 m/s and 1.2 m/s^2.
    """
    x, v, u = driven.unbind(-1)
    slid = v + DT * (u - 0.8 * v.sign() - 0.1 * v)
    v = torch.where((v.abs() < 0.05) & (u.abs() < 1.2), 0.0, slid)
    return torch.stack([x + DT * v, v], -1)


def speed_std(speed: Tensor) -> Tensor:
    """Returns the standard deviation of the process noise of the speed, m/s."""
    return 0.02 + 0.1 * speed.abs()


def reading_std(position: Tensor) -> Tensor:
    """Returns the standard deviation of a reading that is no outlier, m."""
    return 0.02 + 0.05 * position.abs()


class SpeedNoise(SubModel):
    """Computes Q at the belief's mean."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "mean")], [("forecast", "noise")])

    def compute(self, mean):
        """Returns the variances ``[*B, 2]``."""
        variance = speed_std(mean[..., 1]).square()
        return torch.stack([torch.zeros_like(variance), variance], -1)


class ReadingNoise(SubModel):
    """Computes R without outliers at a forecast: at its mean ``[*B, 2]``, or averaged over members ``[*B, E, 2]``."""

    def __init__(self, name: str):
        super().__init__(nn.Identity(), [("forecast", name)], [("sensor", "noise")])
        self.of_members = name == "ensemble"

    def compute(self, state):
        """Returns the variance ``[*B, 1]``."""
        variance = reading_std(state[..., :1]).square()
        return variance.mean(-2) if self.of_members else variance


def drives(runs: int, steps: int, generator: torch.Generator) -> Tensor:
    """Returns drives ``[runs, steps, 1]``: sines of 0.3 to 0.8 Hz with an offset, up to 4 m/s^2."""
    rate, phase, size, offset = (torch.rand(4, runs, 1, generator=generator)).unbind()
    time = DT * torch.arange(steps)
    sine = (2 * math.pi * ((0.3 + 0.5 * rate) * time + phase)).sin()
    return ((1 + 2 * size) * sine + 2 * offset - 1).unsqueeze(-1)


def recordings(runs: int, seed: int, steps: int = STEPS) -> TensorDict:
    """Returns true states ``[runs, steps, 2]``, drives, and readings; the first reading is of the initial state."""
    generator = torch.Generator().manual_seed(seed)
    draw = partial(torch.randn, generator=generator)
    action, states = drives(runs, steps, generator), [torch.tensor(START) * draw(runs, 2)]
    for t in range(steps - 1):
        state = moved(torch.cat([states[-1], action[:, t]], -1))
        state[:, 1] += speed_std(states[-1][:, 1]) * draw(runs)
        states.append(state)
    state = torch.stack(states, 1)
    wrong = torch.rand(runs, steps, 1, generator=generator) < SHARE
    std = torch.where(wrong, WRONG, reading_std(state[..., :1]))
    reading = state[..., :1] + std * draw(runs, steps, 1)
    return TensorDict({"state": state, "action": action, "reading": reading, "wrong": wrong}, [runs, steps])


def best(data: TensorDict, particles: int, kept: int = 2000) -> dict[str, Tensor]:
    """Returns errors, CRPS and coverage ``[runs, steps, 2]`` of a particle filter with the true model."""
    generator = torch.Generator().manual_seed(0)
    draw, found = partial(torch.randn, generator=generator), {"error": [], "crps": [], "held": []}
    for run in data.unbind(0):
        state, rows = torch.tensor(START) * draw(particles, 2), {name: [] for name in found}
        for t in range(len(run)):
            if t:
                std = speed_std(state[:, 1])
                state = moved(torch.cat([state, run["action"][t - 1].expand(particles, 1)], -1))
                state[:, 1] += std * draw(particles)
            off, sound = run["reading"][t] - state[:, 0], reading_std(state[:, 0])
            weight = (1 - SHARE) / sound * torch.exp(-0.5 * (off / sound).square())
            weight = (weight + SHARE / WRONG * torch.exp(-0.5 * (off / WRONG).square())).double()
            edges = weight.cumsum(0) / weight.sum()
            place = torch.arange(particles, dtype=torch.float64) + torch.rand(1, generator=generator).double()
            state = state[torch.searchsorted(edges, place / particles).clamp(max=particles - 1)]
            some, truth = state[:: max(1, particles // kept)], run["state"][t]
            low, high = torch.quantile(some, torch.tensor([0.05, 0.95]), dim=0)
            rows["error"].append(state.mean(0) - truth)
            rows["crps"].append(crps_ensemble(some, truth))
            rows["held"].append(((truth >= low) & (truth <= high)).float())
        for name, values in rows.items():
            found[name].append(torch.stack(values))
    return {name: torch.stack(values) for name, values in found.items()}
