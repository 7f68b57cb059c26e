r"""Transition models: forecast :math:`x^i_{t|t-1} \sim f_\theta(x^i_{t-1|t-1})` (the paper's eq. 5)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import nn

from torch_denkf.modules._base import SubModel
from torch_denkf.modules.stochastic import StochasticMLP

__all__ = ["LearnedTransition"]


class StochasticTransition(SubModel):
    """A transition of an ensemble whose noise is that of a stochastic network."""

    def __init__(self, network: nn.Module, in_keys, out_keys, ensemble_size: int | None, noise_key: NestedKey):
        super().__init__(network, in_keys, out_keys, noise_key=noise_key)
        self.ensemble_size = ensemble_size

    def draw_noise(self, batch_size, *, device=None, dtype=None, generator=None):
        """Draws the network's noise for ``[*batch_size, E]`` rows; needs ``ensemble_size``."""
        if self.ensemble_size is None or not isinstance(self.module, StochasticMLP):
            return None
        return self.module.draw_noise(batch_size, self.ensemble_size, device=device, dtype=dtype, generator=generator)

    def _run(self, features: torch.Tensor, tensordict: TensorDictBase) -> torch.Tensor:
        if not isinstance(self.module, StochasticMLP):
            return self.module(features)
        noise = self.read_noise(tensordict)
        if noise is None and self.module.sample and self.module.noise_size:
            noise = self.module.draw_noise(
                features.shape[:-2], features.shape[-2], device=features.device, dtype=features.dtype
            )
        return self.module(features, noise)


class LearnedTransition(StochasticTransition):
    r"""A learned transition, residual by default: :math:`x_t = x_{t-1} + s \circ f_\theta((x_{t-1} - m) / s, a)`.

    Args:
        network: maps ``[*, S]`` (or ``[*, S + A]`` with an action) to ``[*, S]``; a :class:`StochasticMLP` makes
            the process noise.
        residual: adds the input state to the output.
        loc: mean :math:`m` of each state dimension, ``[S]``, in the state's units.
        scale: standard deviation :math:`s` of each state dimension, ``[S]``; the network works in these units.
        action_key: entry ``[*B, A]`` that drives the transition *into* the new state, i.e. the action taken at
            the previous step; ``None`` for none.
        ensemble_size: number of members, needed only to draw noise for a whole sequence in bulk; a
            :class:`~torch_denkf.filters.Filter` sets it.
        in_key: the belief's ensemble ``[*B, E, S]``.
        out_key: the forecast ensemble ``[*B, E, S]``.
        noise_key: optional noise (see :class:`StochasticMLP`).

    Raises:
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> transition = LearnedTransition(StochasticMLP(4, 4))
        >>> td = TensorDict({("belief", "ensemble"): torch.zeros(32, 4)})
        >>> transition(td)["forecast", "ensemble"].shape
        torch.Size([32, 4])
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        residual: bool = True,
        loc: torch.Tensor | Sequence[float] | None = None,
        scale: torch.Tensor | Sequence[float] | None = None,
        action_key: NestedKey | None = None,
        ensemble_size: int | None = None,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
        noise_key: NestedKey = ("noise", "transition"),
    ):
        in_keys = [in_key] if action_key is None else [in_key, action_key]
        super().__init__(network, in_keys, [out_key], ensemble_size, noise_key)
        self.residual, self.action_key = residual, action_key
        self.register_buffer("loc", None if loc is None else torch.as_tensor(loc, dtype=torch.get_default_dtype()))
        self.register_buffer(
            "scale", None if scale is None else torch.as_tensor(scale, dtype=torch.get_default_dtype())
        )

    runs_on_rows = True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the forecast ensemble."""
        state = self.read(tensordict, self.in_keys[0])
        features = state if self.loc is None else state - self.loc
        if self.scale is not None:
            features = features / self.scale
        if self.action_key is not None:
            action = self.read(tensordict, self.action_key).to(state.dtype).unsqueeze(-2)
            features = torch.cat([features, action.expand(*state.shape[:-1], action.shape[-1])], -1)
        change = self._run(features, tensordict)
        if self.scale is not None:
            change = change * self.scale
        if self.residual:
            change = state + change
        elif self.loc is not None:
            change = change + self.loc
        tensordict.set(self.out_keys[0], change)
        return tensordict
