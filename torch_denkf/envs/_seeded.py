"""Base class of simulated environments, with a random generator on the environment's device."""

from __future__ import annotations

import torch
from torchrl.envs import EnvBase

__all__ = ["SeededEnv"]


class SeededEnv(EnvBase):
    """Draws from the generator ``rng`` instead of the global one; ``rng`` is seeded again when the device changes."""

    rng: torch.Generator

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator().manual_seed(0 if seed is None else seed)

    def _source(self, like: torch.Tensor) -> dict:
        """Returns the device of ``like`` and a generator on it, as arguments of ``torch.rand``."""
        if like.is_meta:
            return {"device": like.device}
        if self.rng.device != like.device:
            self.rng = torch.Generator(like.device).manual_seed(self.rng.initial_seed())
        return {"device": like.device, "generator": self.rng}
