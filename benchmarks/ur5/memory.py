"""A recurrent network on a sensor's readings: what memory alone gets out of them, without a model of the arm."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from benchmarks.ur5.recipes._base import INITIAL

UNITS, UPDATES, LENGTH, BATCH = 48, 500, 150, 32


class Memory(nn.Module):
    """A GRU that corrects each of D numbers from all its readings so far; one network, which is told the number.

    Args:
        readings: demos ``[N, T, D]`` to fit on.
        truth: likewise.
        updates: on windows of 150 steps.
    """

    def __init__(self, readings: Tensor, truth: Tensor, *, updates: int = UPDATES):
        super().__init__()
        self.error = (readings - truth).square().mean((0, 1)).sqrt()
        self.loc, self.scale = truth.mean((0, 1)), truth.std((0, 1))
        self.change = readings.diff(dim=1).std((0, 1))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.memory = nn.GRU(4 + truth.shape[-1], UNITS, batch_first=True)
            self.head = nn.Linear(UNITS, 2)
            nn.init.zeros_(self.head.weight)
            self._fit(readings, truth, updates)

    def _fit(self, readings: Tensor, truth: Tensor, updates: int) -> None:
        optimiser = torch.optim.Adam(self.parameters(), lr=3e-3)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
        length = min(LENGTH, truth.shape[1])
        for _ in range(updates):
            rows = torch.randint(len(truth), (BATCH,))
            first = int(torch.randint(truth.shape[1] - length + 1, ()))
            seen, true = readings[rows, first : first + length], truth[rows, first : first + length]
            start = true[:, 0] + INITIAL * self.scale * torch.randn(true[:, 0].shape)
            correction, log_size = self._say(seen, start)
            # The likelihood of a Laplace distribution: absolute errors are what the table counts.
            loss = (((true - seen) / self.error - correction).abs() / log_size.exp() + log_size).mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.parameters(), 1.0)
            optimiser.step()
            schedule.step()

    def _say(self, readings: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
        count, _, numbers = readings.shape
        change = torch.cat([torch.zeros_like(readings[:, :1]), readings.diff(dim=1)], 1)
        wrong = ((start - readings[:, 0]) / self.error).unsqueeze(1).expand_as(readings)
        away = (start.unsqueeze(1) - readings) / self.scale
        features = torch.stack([(readings - self.loc) / self.scale, change / self.change, away, wrong], -1)
        which = torch.eye(numbers).expand(*features.shape[:-1], numbers)
        rows = torch.cat([features, which], -1).transpose(1, 2).flatten(0, 1)
        said = self.head(self.memory(rows)[0]).unflatten(0, (count, numbers)).transpose(1, 2)
        return said[..., 0], said[..., 1]

    def forward(self, readings: Tensor, start: Tensor) -> Tensor:
        """Numbers ``[N, T, D]`` of readings ``[N, T, D]``, from ``start`` ``[N, D]``."""
        return readings + self._say(readings, start)[0] * self.error
