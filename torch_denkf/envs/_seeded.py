"""Base of simulated environments: a random generator of their own, on their device."""

from __future__ import annotations

import torch
from torchrl.envs import EnvBase

__all__ = ["SeededEnv"]


class SeededEnv(EnvBase):
    """An environment that draws from a generator of its own, ``rng``, which restarts where it moves to a device."""

    rng: torch.Generator

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator().manual_seed(0 if seed is None else seed)

    def _source(self, like: torch.Tensor) -> dict:
        """Returns where to draw numbers next to ``like``, as arguments of ``torch.rand``."""
        if like.is_meta:
            return {"device": like.device}
        if self.rng.device != like.device:
            self.rng = torch.Generator(like.device).manual_seed(self.rng.initial_seed())
        return {"device": like.device, "generator": self.rng}
