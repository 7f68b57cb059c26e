"""Trains the noise of each sensor and of the motion, and the attention weights between sensors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.optim.lr_scheduler import OneCycleLR

from benchmarks.common.descent import minimise
from benchmarks.fusion.task import FAULTS, Task, faulty, without
from torch_denkf.fusion import SensorAttention

FLOOR = 1e-4  # smallest weight: the encoders run at eight times the camera's rate, with a tenth of its noise


def make_weights(task: Task, seed: int = 0) -> SensorAttention:
    """Returns the untrained attention network of a task."""
    torch.manual_seed(seed)
    sizes = {name: len(noise) for name, noise in task.noises.items()}
    features = {name: task.train[f"{name}_features"].shape[-1] for name in sizes}
    return SensorAttention(sizes, features=features, floor=FLOOR, slope=task.slope)


def train(task: Task, weights: nn.Module, *, updates: tuple[int, int], window: int, batch: int, seed: int = 0) -> None:
    """Trains the noise, then the attention network on windows with sensor faults; both in place.

    In a third of the windows one sensor is absent, so that the others are trained without it. In half of the windows
    for the attention network one sensor fails. The start-up of a window has no fault and is not scored.

    Args:
        task: the task.
        weights: the attention network.
        updates: number of updates of the noise, and of the attention network.
        window: length of a window in steps.
        batch: windows in an update.
        seed: draws the windows and their faults.
    """
    generator, settled = torch.Generator().manual_seed(seed), task.settled

    def integer(low: int, high: int) -> Tensor:
        return torch.randint(low, high, (1,), generator=generator)

    def draw(names: Sequence[str]) -> str:
        return names[int(integer(0, len(names)))]

    def sample(fail: bool) -> TensorDict:
        rows = torch.randint(task.train.shape[0], (batch, 1), generator=generator)
        starts = torch.randint(task.train.shape[1] - window + 1, (batch, 1), generator=generator)
        parts = []
        for number, part in enumerate(task.train[rows, starts + torch.arange(window)].split(1)):
            if number % 6 < 2:
                part = without(part, draw(task.sensors))
            elif fail and number % 6 < 5:
                begin, length = integer(settled.start, window // 2), integer(window // 4, window)
                name, fault = draw(task.failing), draw(FAULTS)
                part = faulty(task, part, name, fault, begin, begin + length, generator)
            parts.append(part)
        return torch.cat(parts)

    def fit(network: nn.Module | None, trained: nn.Module, fail: bool, updates: int, rate: float) -> None:
        model, keep = task.build(network, False), [("belief", "mean"), ("belief", "var")]
        one_cycle = partial(OneCycleLR, max_lr=rate, total_steps=max(updates, 2), pct_start=0.2)

        def loss() -> Tensor:
            return task.loss(model.sequence(sample(fail), keep=keep)[:, settled])

        minimise(trained.parameters(), loss, updates, rate, schedule=one_cycle, clip=1.0)

    fit(None, task.parts, False, updates[0], 5e-2)
    fit(weights, weights, True, updates[1], 2e-2)
