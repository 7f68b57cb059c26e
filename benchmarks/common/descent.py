"""Training by Adam that a few studies share; those with stages and checkpoints use ``torch_denkf.training``."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler


def minimise(
    parameters: Iterable[nn.Parameter],
    loss: Callable[[], Tensor],
    updates: int,
    rate: float,
    *,
    schedule: Callable[[Optimizer], LRScheduler] | None = None,
    clip: float | None = None,
    after: Callable[[int], object] | None = None,
) -> None:
    """Minimises a loss by Adam.

    Args:
        parameters: changed in place.
        loss: draws a batch and returns its loss.
        updates: number of updates.
        rate: learning rate.
        schedule: makes a schedule of the rate; ``None`` keeps it constant.
        clip: largest norm of the gradient; ``None`` for no clipping.
        after: called with the number of each update, from 1 on.
    """
    parameters = list(parameters)
    optimiser = torch.optim.Adam(parameters, rate)
    rates = schedule(optimiser) if schedule is not None else None
    for update in range(1, updates + 1):
        value = loss()
        optimiser.zero_grad()
        value.backward()
        if clip is not None:
            nn.utils.clip_grad_norm_(parameters, clip)
        optimiser.step()
        if rates is not None:
            rates.step()
        if after is not None:
            after(update)
