"""Trains filters on a simulated system with a biased, heteroscedastic sensor, and compares error and calibration of
several losses.

A particle in the plane, state [x, y, vx, vy]: a spring pulls it to the origin, a cross wind deflects it, random gusts
push it. Four noisy instruments read it through a saturating curve; one half of the plane is foggy (noise six times
larger, and a bias). Everything is learned: transition, observation model, noise model, sensor. Every loss trains the
same networks (the paper's Table I) on the same runs for the same number of updates.

    python -m benchmarks.lorenz96 calibration   # the table of benchmarks/lorenz96/results/calibration.md
"""

from __future__ import annotations

import platform
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.optim.lr_scheduler import OneCycleLR

from benchmarks.common.arguments import command
from benchmarks.common.descent import minimise
from benchmarks.common.tables import head, line, write_page
from torch_denkf.filters import DEnKF
from torch_denkf.metrics import spread_skill_ratio
from torch_denkf.modules import (
    AroundState,
    DiagonalNoise,
    EnsembleAnalysis,
    LearnedTransition,
    Select,
    StochasticMLP,
    VectorSensor,
)
from torch_denkf.objectives import DEnKFLoss

DT, ENSEMBLE = 0.1, 32
TITLES = ("loss", "steps", "seed", "sensor RMSE", "filter RMSE", "spread/skill", "worst dimensions", "coverage of 90 %")


def simulate(runs: int, steps: int, rng: torch.Generator) -> TensorDict:
    """Returns ``state`` and ``measurement``, both [runs, steps, 4]."""
    state = torch.randn(runs, 4, generator=rng) * 1.2
    states = []
    for _ in range(steps):
        position, velocity = state.split(2, -1)
        turned = torch.stack([-velocity[:, 1], velocity[:, 0]], -1)
        gust = 0.6 * torch.randn(runs, 2, generator=rng) * DT**0.5
        velocity = velocity + DT * (-position - 0.3 * velocity + 0.8 * turned) + gust
        state = torch.cat([position + DT * velocity, velocity], -1)
        states.append(state)
    state = torch.stack(states, 1)
    foggy = torch.sigmoid(8 * state[..., :1])
    noise = (0.1 + 0.5 * foggy) * torch.randn(state.shape, generator=rng)
    measurement = torch.tanh(0.6 * state) * 2 + 0.4 * foggy + noise
    return TensorDict({"state": state, "measurement": measurement}, [runs, steps])


def make_filter() -> DEnKF:
    return DEnKF(
        transition=LearnedTransition(StochasticMLP(4, 4, output_gain=0.1)),
        sensor=VectorSensor(4, 4, ensemble_size=ENSEMBLE),
        observation=Select([0, 1, 2, 3]),
        noise=DiagonalNoise(4, r=0.5),
        analysis=EnsembleAnalysis("sensor"),
        initial=AroundState([0.2] * 4, ensemble_size=ENSEMBLE),
    )


def train(loss_name: str, data: TensorDict, updates: int, length: int, seed: int) -> DEnKF:
    torch.manual_seed(seed)
    denkf = make_filter()
    loss = DEnKFLoss.paper(denkf) if loss_name == "mse" else DEnKFLoss(denkf, score=loss_name)

    def batch_loss() -> Tensor:
        rows, start = torch.randint(data.shape[0], (64,)), int(torch.randint(data.shape[1] - length + 1, ()))
        return sum(loss(data[rows, start : start + length]).values())

    one_cycle = partial(OneCycleLR, max_lr=2e-3, total_steps=updates)
    minimise(denkf.parameters(), batch_loss, updates, 2e-3, schedule=one_cycle, clip=1.0)
    return denkf


@torch.no_grad()
def evaluate(denkf: DEnKF, data: TensorDict, seed: int) -> dict[str, float]:
    torch.manual_seed(seed)
    out = denkf.sequence(data.copy())[:, 10:]
    truth, mean, var = data[:, 10:]["state"], out["belief", "mean"], out["belief", "var"]
    sensor = out["sensor", "ensemble"].mean(-2)
    ratio = spread_skill_ratio(mean, var, truth, ENSEMBLE)
    inside = (mean - truth).abs() <= 1.645 * var.sqrt() * (1 + 1 / ENSEMBLE) ** 0.5
    return {
        "sensor": (sensor - truth).square().mean().sqrt().item(),
        "filter": (mean - truth).square().mean().sqrt().item(),
        "spread/skill": ratio.mean().item(),
        "lowest": ratio.min().item(),
        "highest": ratio.max().item(),
        "coverage90": inside.float().mean().item(),
    }


@dataclass
class Calibration:
    """Options of the study of a biased, heteroscedastic sensor."""

    updates: int = 1000
    seeds: int = 3
    out: Path = Path("benchmarks/lorenz96/results/calibration.md")
    smoke: bool = False  # a few updates, nothing written

    def __call__(self) -> None:
        """Trains with each loss and writes the table."""
        if self.smoke:
            self.updates, self.seeds = 5, 1
        began, rng = time.perf_counter(), torch.Generator().manual_seed(0)
        training, unseen = simulate(400, 100, rng), simulate(100, 100, rng)
        lines = head(*TITLES)
        for loss, length in (("crps", 16), ("energy", 16), ("mse", 16), ("crps", 2), ("mse", 2)):
            for seed in range(self.seeds):
                scores = evaluate(train(loss, training, self.updates, length, seed), unseen, seed)
                name, worst = loss.replace("mse", "mse (the paper's)"), "{lowest:.2f} to {highest:.2f}".format(**scores)
                cells = [f"{scores['sensor']:.3f}", f"{scores['filter']:.3f}", f"{scores['spread/skill']:.2f}", worst]
                lines.append(line(name, length - 1, seed, *cells, f"{100 * scores['coverage90']:.0f} %"))
                print(lines[-1], flush=True)
        header = (
            f"`{command('lorenz96')}`: {time.perf_counter() - began:.0f} s on one core ({platform.machine()}). 400 "
            "runs of 100 steps to train on, 100 unseen runs to test on; E = "
            f"{ENSEMBLE}, batch 64. 'steps' is the number of filter steps back-propagated through. RMSE over the four "
            "state dimensions, first 10 steps of a run left out."
        )
        page = "\n".join(["# Calibration on a simulated system", "", header, "", *lines]) + "\n"
        write_page(page, None if self.smoke else self.out)
