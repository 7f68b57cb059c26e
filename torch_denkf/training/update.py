"""One update: loss, gradient, clipping, step; and means over the last updates for logs."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch.nn.utils import clip_grads_with_norm_, get_total_norm

from torch_denkf.training.distributed import Processes
from torch_denkf.training.stage import Stage

__all__ = ["Updates", "seed_update"]


def seed_update(seed: int, stage: int, update: int, rank: int = 0) -> torch.Generator:
    """Seeds Python, NumPy and torch (all devices) for one update, and returns a generator for its batch.

    An update's random numbers are a function of its number and its process. So a checkpoint needs no state of any
    generator, and random draws in between do not change a training.

    Args:
        seed: seed of the run, at least 0.
        stage: number of the stage.
        update: number of the update, from 0.
        rank: number of the process.

    Example:
        >>> first = torch.rand(2, generator=seed_update(0, 0, 7))
        >>> torch.equal(first, torch.rand(2, generator=seed_update(0, 0, 7)))
        True
        >>> torch.equal(first, torch.rand(2, generator=seed_update(0, 0, 7, rank=1)))
        False
    """
    batch, rest = np.random.SeedSequence((seed, stage, update, rank)).generate_state(2).tolist()
    random.seed(rest)
    np.random.seed(rest)
    torch.manual_seed(rest)
    return torch.Generator().manual_seed(batch)


class Updates:
    """Optimiser of a stage, with sums over the updates since the last call of :meth:`summary`.

    Args:
        stage: the stage.
        groups: the trained parameters, from :meth:`Stage.groups`.
        processes: processes over which the gradient is averaged.

    Attributes:
        skipped: number of skipped updates of the stage, whose loss or gradient was not finite.
        in_a_row: number of successive skipped updates up to the last one.
        cause: names of the non-finite entries in the last skipped batch; empty if all were finite.

    Example:
        >>> net = torch.nn.Linear(1, 1, bias=False)
        >>> loss = lambda batch: {"loss_fit": (net(batch["x"]) - 2.0).square().mean()}
        >>> stage = Stage("fit", loss, None, updates=1, lr=0.1, schedule="constant")
        >>> updates = Updates(stage, stage.groups(net), Processes("cpu"))
        >>> updates.step({"x": torch.full((1, 1), torch.nan)}), updates.step({"x": torch.ones(1, 1)})
        (False, True)
    """

    def __init__(self, stage: Stage, groups: list[dict], processes: Processes):
        self.stage, self.processes = stage, processes
        self.optimiser, self.schedule = stage.optimiser(groups)
        self.parameters = [parameter for group in groups for parameter in group["params"]]
        self.skipped = self.in_a_row = self._count = 0
        self._sums: dict[str, torch.Tensor] = {}
        self._lr, self.cause = 0.0, ""

    def step(self, batch: TensorDictBase) -> bool:
        """Makes one optimiser step, unless the loss or its gradient is not finite.

        A skipped step does not change parameters, optimiser and schedule. The check for finite values is the only
        synchronisation with the device.

        Returns:
            whether the step was made; the same in all processes.
        """
        terms = self._terms(batch)
        first, *others = [value for name, value in terms.items() if name.startswith("loss")]
        total = sum(others, first)
        if not total.requires_grad:
            raise ValueError(f"Stage {self.stage.name!r}: its loss does not depend on the parameters it trains.")
        self.optimiser.zero_grad()
        total.backward()
        names = sorted(terms)
        values = torch.stack([*(terms[name].to(total.dtype) for name in names), total]).detach()
        values = self.processes.average_(self.parameters, values)
        norm = get_total_norm([p.grad for p in self.parameters if p.grad is not None])
        if not bool(torch.isfinite(values[-1] + norm)):
            return self._skip(batch)
        self.in_a_row = 0
        if self.stage.clip is not None:
            clip_grads_with_norm_(self.parameters, self.stage.clip, norm)
        self._lr = self.optimiser.param_groups[0]["lr"]
        self.optimiser.step()
        self.schedule.step()
        for name, value in dict(zip([*names, "loss", "grad_norm"], [*values, norm], strict=True)).items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value.clone()
        self._count += 1
        return True

    def _skip(self, batch: TensorDictBase) -> bool:
        """Skips the step, and names the entries of the batch that are not finite."""
        self.skipped, self.in_a_row = self.skipped + 1, self.in_a_row + 1
        values = batch.items(True, True) if isinstance(batch, TensorDictBase) else batch.items()
        keys = [key for key, value in values if value.is_floating_point() and not bool(value.isfinite().all())]
        self.cause = f"{keys} of its batch hold NaN or infinity: RejectReadings hides such readings." if keys else ""
        self.optimiser.zero_grad()
        return False

    def summary(self) -> dict[str, float]:
        """Returns means over the updates since the last call: terms, their sum ``loss``, the unclipped gradient norm.

        Also ``lr`` (of the first group, at the last update) and ``skipped``, counted from the start of the stage.
        """
        values = {name: float(value) / self._count for name, value in self._sums.items()}
        if self._count:
            values["lr"] = float(self._lr)
        self._sums, self._count = {}, 0
        return {**values, "skipped": float(self.skipped)}

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the optimiser, the schedule and the sums, without the model."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict(),
            "skipped": self.skipped,
            "in_a_row": self.in_a_row,
            "count": self._count,
            "lr": self._lr,
            "sums": dict(self._sums),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state of :meth:`state_dict`."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])
        self.skipped, self.in_a_row, self._count = state["skipped"], state["in_a_row"], state["count"]
        self._lr = state["lr"]
        self._sums = {name: value.to(self.processes.device) for name, value in state["sums"].items()}

    def _terms(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        terms = dict(self.stage.loss(batch).items())
        if not any(name.startswith("loss") for name in terms):
            raise ValueError(f'Stage {self.stage.name!r}: no entry of {sorted(terms)} starts with "loss".')
        for name, value in terms.items():
            if value.numel() != 1:
                raise ValueError(f"Stage {self.stage.name!r}: {name!r} is {list(value.shape)}; reduce it to a scalar.")
        return {name: value.reshape(()) for name, value in terms.items()}
