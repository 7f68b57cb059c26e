"""Networks that run on every member of an ensemble, and draw their noise for each."""

from __future__ import annotations

import torch

from torch_denkf.modules._base import SubModel
from torch_denkf.modules.stochastic import StochasticMLP

__all__ = ["MemberNetwork"]


class MemberNetwork(SubModel):
    """A sub-model whose first input is an ensemble; a stochastic network draws noise for each of its members."""

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Those of the network."""
        return getattr(self.module, "noise_names", ())

    def draw_noise(self, batch_size, *, members=None, time=False, device=None, dtype=None, generator=None, **_):
        """Draws the network's noise for ``[*batch_size, E]`` rows."""
        if members is None or not self.noise_names:
            return None
        return self.module.draw_noise(
            batch_size, members, time=time, device=device, dtype=dtype, generator=generator
        )

    def noise_sizes(self, state, *_):
        """E, from the ensemble."""
        return {"members": state.shape[-2]}

    def _run(self, features: torch.Tensor, noise) -> torch.Tensor:
        if not isinstance(self.module, StochasticMLP):
            return self.module(features)
        return self.module(features, noise, sample=noise is not None)
