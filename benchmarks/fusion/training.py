"""The training of what is little: the noise of each sensor and of the motion, and the weights between sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.fusion.task import FAULTS, Task, faulty
from torch_denkf.modules import SensorAttention

__all__ = ["make_weights", "train"]


def make_weights(task: Task) -> SensorAttention:
    """The network of a task's weights, untrained."""
    torch.manual_seed(0)
    sizes = {name: len(noise) for name, noise in task.noises.items()}
    return SensorAttention(sizes, features=sizes)


def train(task: Task, weights: nn.Module, *, updates: tuple[int, int], window: int, batch: int, seed: int = 0) -> None:
    """Trains the noise on clean windows, and then the weights on windows in which a sensor fails, both in place.

    Args:
        task: the task.
        weights: the network of the weights.
        updates: of the noise, and of the weights.
        window: steps.
        batch: windows in an update.
        seed: of the windows and their faults.
    """
    generator = torch.Generator().manual_seed(seed)

    def clean() -> TensorDict:
        rows = torch.randint(task.train.shape[0], (batch, 1), generator=generator)
        starts = torch.randint(task.train.shape[1] - window + 1, (batch, 1), generator=generator)
        return task.train[rows, starts + torch.arange(window)]

    def failing() -> TensorDict:
        data, parts = clean(), []
        # A third of the windows stays as it is; in the others one sensor fails, and comes back or does not.
        kinds = [(name, fault) for name in task.sensors for fault in FAULTS]
        for part in data.split(1):
            choice = int(torch.randint(len(kinds) * 3 // 2, (), generator=generator))
            if choice < len(kinds):
                begin = torch.randint(window // 8, window // 2, (1,), generator=generator)
                length = torch.randint(window // 4, window, (1,), generator=generator)
                part = faulty(task, part, *kinds[choice], begin, begin + length, generator)
            parts.append(part)
        return torch.cat(parts)

    fit(task.build(None, False), task.loss, clean, task.parts.parameters(), updates[0], 3e-2)
    fit(task.build(weights, False), task.loss, failing, weights.parameters(), updates[1], 1e-2)


def fit(
    model: nn.Module,
    loss: Callable[[TensorDict], Tensor],
    sample: Callable[[], TensorDict],
    parameters: Iterable[nn.Parameter],
    updates: int,
    lr: float,
) -> None:
    """Minimises a loss of what a filter believes."""
    parameters = list(parameters)
    optimiser = torch.optim.Adam(parameters, lr)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, lr, total_steps=max(updates, 2))
    for _ in range(updates):
        value = loss(model.sequence(sample()))
        optimiser.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimiser.step()
        schedule.step()
