"""Processes of a data-parallel training under ``torchrun``."""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterable
from typing import Any, TypeVar

import torch
from torch import distributed as dist
from torch import nn

__all__ = ["Processes"]

T = TypeVar("T")


class Processes:
    """Rank, world size and device of this process; without ``torchrun`` it is the only one.

    Gradients are averaged by hand, not by ``DistributedDataParallel``: that wraps one module's ``forward`` and finds
    the tensors in its output, while a loss here is any callable whose output is a tensordict. The one flat vector that
    is summed per update includes the loss terms, so that all processes agree on whether a step is finite.

    Args:
        device: device of this process; by default its GPU if there is one, else the CPU.

    Attributes:
        rank: number of this process, from 0.
        world_size: number of processes.
        device: the device.

    Example:
        >>> processes = Processes("cpu")
        >>> processes.rank, processes.world_size, processes.is_main
        (0, 1, True)
    """

    def __init__(self, device: torch.device | str | None = None):
        local_rank = int(os.environ.get("LOCAL_RANK", 0))
        if device is None:
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self.device = torch.device(device)
            torch.empty(0, device=self.device)
        except (AssertionError, AttributeError, RuntimeError) as error:
            raise ValueError(f"device {device!r} cannot be used here: {' '.join(str(error).split())}") from error
        if self.device.type == "cuda":
            index = local_rank if self.device.index is None else self.device.index
            self.device = torch.device("cuda", index)
            torch.cuda.set_device(self.device)
        if not dist.is_initialized() and int(os.environ.get("WORLD_SIZE", 1)) > 1:
            dist.init_process_group("nccl" if self.device.type == "cuda" else "gloo")
            atexit.register(_leave)
        self.rank, self.world_size = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)

    @property
    def is_main(self) -> bool:
        """Returns True in the process that validates, logs and writes checkpoints."""
        return self.rank == 0

    def share(self, value: T) -> T:
        """Returns the first process's ``value`` (anything that can be pickled) in all of them."""
        if self.world_size == 1:
            return value
        box: list[Any] = [value]
        dist.broadcast_object_list(box, src=0)
        return box[0]

    def any(self, here: bool) -> bool:
        """Returns True in all processes if ``here`` is True in any."""
        if self.world_size == 1:
            return here
        count = torch.tensor(int(here), device=self.device)
        dist.all_reduce(count)
        return bool(count)

    def average_(self, parameters: Iterable[nn.Parameter], values: torch.Tensor) -> torch.Tensor:
        """Averages the gradients in place over the processes.

        A missing gradient counts as zero if another process has one; else it stays missing.

        Args:
            parameters: the trained parameters, in the same order in all processes.
            values: ``[K]``, averaged over the processes, too.

        Returns:
            the averaged values, ``[K]``.
        """
        if self.world_size == 1:
            return values
        parameters = list(parameters)
        has_gradient = torch.tensor([p.grad is not None for p in parameters], dtype=values.dtype, device=values.device)
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([values, has_gradient, *(gradient.detach().flatten() for gradient in gradients)])
        dist.all_reduce(flat)  # adds; the same bits in every process
        sizes = [len(values), len(has_gradient), *(p.numel() for p in parameters)]
        values, has_gradient, *gradients = flat.split(sizes)
        for parameter, flag, gradient in zip(parameters, has_gradient.tolist(), gradients, strict=True):
            # A parameter without a gradient has no weight decay, as in a single process.
            parameter.grad = (gradient / self.world_size).view_as(parameter).to(parameter.dtype) if flag else None
        return values / self.world_size


def _leave() -> None:
    if dist.is_initialized():
        dist.destroy_process_group()
