"""The two systems: their motion as a transition, their truth and readings, with one generator per seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.lorenz96 import lorenz96_step
from torch_denkf.modules import SubModel


@dataclass(frozen=True)
class System:
    """A chaotic system, whose whole state is observed once in each cycle of small steps.

    Attributes:
        step: one small step of states ``[*, N]``.
        mean: of the first state, ``N`` components.
        variance: of each of its components.
        noise: variance of the readings.
        steps: small steps in a cycle.
        burn_in: first cycles, which are not scored.
    """

    step: Callable[[Tensor], Tensor]
    mean: tuple[float, ...]
    variance: float
    noise: float
    steps: int
    burn_in: int

    def counts_from(self, cycles: int) -> int:
        """Returns the first scored cycle, at the latest the middle one."""
        return min(self.burn_in, cycles // 2)


def lorenz63_step(state: Tensor, dt: float = 0.01) -> Tensor:
    """Returns one Runge-Kutta step of the system of Lorenz 1963, states ``[*, 3]``."""

    def tendency(state: Tensor) -> Tensor:
        x, y, z = state.unbind(-1)
        return torch.stack([10 * (y - x), 28 * x - y - x * z, x * y - 8 / 3 * z], -1)

    k1 = tendency(state)
    k2 = tendency(state + dt / 2 * k1)
    k3 = tendency(state + dt / 2 * k2)
    k4 = tendency(state + dt * k3)
    return state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


SYSTEMS = {
    # Sakov, Oliver & Bertino 2012; Raanes 2016. As in DAPPER's mods Lorenz63/sakov2012 and Lorenz96/raanes2016.
    "lorenz63": System(lorenz63_step, (1.509, -1.531, 25.46), 2.0, 2.0, steps=25, burn_in=64),
    "lorenz96": System(
        lambda state: lorenz96_step(state, dt=0.01), (1.0, *[0.0] * 39), 0.001, 1.0, steps=15, burn_in=133
    ),
}


class Cycle(SubModel):
    """Transition of members over one cycle."""

    def __init__(self, system: System):
        super().__init__(nn.Identity(), [("belief", "ensemble")], [("forecast", "ensemble")])
        self.system = system

    def compute(self, ensemble):
        """Returns the forecast."""
        for _ in range(self.system.steps):
            ensemble = self.system.step(ensemble)
        return ensemble


def simulate(system: System, seeds: Sequence[int], cycles: int) -> tuple[Tensor, Tensor]:
    """Returns true states of all small steps ``[seeds, cycles * steps + 1, N]``, readings ``[seeds, cycles, N]``."""
    mean = torch.tensor(system.mean, dtype=torch.float64)
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    normal = torch.stack([torch.randn(cycles + 1, len(mean), generator=g, dtype=torch.float64) for g in generators])
    path = [mean + system.variance**0.5 * normal[:, 0]]
    for _ in range(cycles * system.steps):
        path.append(system.step(path[-1]))
    truth = torch.stack(path, 1)
    return truth, truth[:, system.steps :: system.steps] + system.noise**0.5 * normal[:, 1:]


def frames_of(readings: Tensor) -> TensorDict:
    """Returns sequences of all seeds ``[seeds, cycles + 1]``; the first element is the start, which has no reading."""
    start = torch.zeros_like(readings[:, :1])
    return TensorDict({"reading": torch.cat([start, readings], 1)}, [len(readings), readings.shape[1] + 1])
