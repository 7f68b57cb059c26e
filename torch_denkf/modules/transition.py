r"""Transition models: forecast :math:`x^i_{t|t-1} \sim f_\theta(x^i_{t-1|t-1})` (the paper's eq. 5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey

from torch_denkf.functional.jacobians import jacobian_of_network
from torch_denkf.modules.stochastic import StochasticMLP
from torch_denkf.modules.tensors import register_location_and_scale
from torch_denkf.submodel import SubModel, Transition

__all__ = ["LearnedTransition", "MemberNetwork"]


class MemberNetwork(SubModel):
    """A sub-model whose first input is an ensemble; a stochastic network draws noise for each of its members."""

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names the noise of the network."""
        return getattr(self.module, "noise_names", ())

    def draw_noise(self, batch_size, *, members=None, time=False, device=None, dtype=None, generator=None, **_):
        """Draws the network's noise for ``[*batch_size, E]`` rows."""
        if members is None or not hasattr(self.module, "draw_noise"):
            return None
        return self.module.draw_noise(batch_size, members, time=time, device=device, dtype=dtype, generator=generator)

    def noise_sizes(self, state, *_):
        """Returns E, from the ensemble."""
        return {"members": state.shape[-2]}

    def _run(self, features: torch.Tensor, noise) -> torch.Tensor:
        if not isinstance(self.module, StochasticMLP):
            return self.module(features)
        return self.module(features, noise, sample=noise is not None)


class LearnedTransition(MemberNetwork, Transition):
    r"""A learned transition, residual by default: :math:`x_t = x_{t-1} + s \circ f_\theta((x_{t-1} - m) / s, a)`.

    For commands with values far from one, such as degrees or encoder ticks, give their mean and standard deviation:
    the network then reads :math:`(a - m_a) / s_a`.

    Args:
        network: maps ``[*, S]`` (or ``[*, S + A]`` with an action) to ``[*, S]``; a :class:`StochasticMLP` adds
            process noise.
        residual: adds the input state to the output.
        loc: mean :math:`m` of each state dimension, ``[S]``, in the state's units.
        scale: standard deviation :math:`s` of each state dimension, ``[S]``; the network works in these units.
        action_key: entry ``[*B, A]`` of the action that leads *into* the new state, i.e. the action taken at
            the previous step; ``None`` for none.
        action_loc: mean of each command ``[A]``, in its units; zero by default.
        action_scale: standard deviation of each command ``[A]``; one by default.
        dt_key: entry ``[*B, 1]`` with the seconds since the last step, for steps of different length: the network
            then computes the rate of change per second, which is multiplied by it (Euler's step); needs ``residual``.
        in_key: the belief's ensemble ``[*B, E, S]``.
        out_key: the forecast ensemble ``[*B, E, S]``.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if it is not ``residual``, and has a ``dt_key``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import StochasticMLP
        >>> transition = LearnedTransition(StochasticMLP(4, 4))
        >>> td = TensorDict({("belief", "ensemble"): torch.zeros(32, 4)})
        >>> transition(td)["forecast", "ensemble"].shape
        torch.Size([32, 4])
    """

    def __init__(
        self,
        network: Callable[..., torch.Tensor],
        *,
        residual: bool = True,
        loc: torch.Tensor | Sequence[float] | None = None,
        scale: torch.Tensor | Sequence[float] | None = None,
        action_key: NestedKey | None = None,
        action_loc: torch.Tensor | Sequence[float] | None = None,
        action_scale: torch.Tensor | Sequence[float] | None = None,
        dt_key: NestedKey | None = None,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        if dt_key is not None and not residual:
            raise ValueError(f"dt_key={dt_key!r} scales a change, and needs residual=True.")
        super().__init__(network, [in_key, *(key for key in (action_key, dt_key) if key is not None)], [out_key])
        self.residual, self.action_key, self.dt_key = residual, action_key, dt_key
        register_location_and_scale(self, loc, scale)
        register_location_and_scale(self, action_loc, action_scale, "action_")

    def compute(self, state, action=None, dt=None, *, noise):
        """Returns the forecast ensemble."""
        return self._moved(state, self._run(self.features(state, action), noise), action, dt)

    def features(self, state: torch.Tensor, action: Any) -> torch.Tensor:
        """Returns the network's inputs, ``[*B, E, S]`` or ``[*B, E, S + A]``, from states and an action."""
        features = state if self.loc is None else state - self.loc
        features = features if self.scale is None else features / self.scale
        if self.action_key is None:
            return features
        action = action if self.action_loc is None else action - self.action_loc
        action = action if self.action_scale is None else action / self.action_scale
        action = action.to(state.dtype).unsqueeze(-2)
        return torch.cat([features, action.expand(*state.shape[:-1], action.shape[-1])], -1)

    def jacobian(self, state, action=None, dt=None):
        """Returns the network's Jacobian in the state's units times the step's length, plus identity if residual."""
        found = jacobian_of_network(self.module, self.features(state, action), state.shape[-1])
        if found is None:
            return None
        matrix = found[1] if self.scale is None else found[1] * (self.scale.unsqueeze(-1) / self.scale)
        if self.dt_key is not None:
            matrix = matrix * (action if dt is None else dt).to(matrix.dtype)[..., None, None]
        if self.residual:
            matrix = matrix + torch.eye(state.shape[-1], dtype=state.dtype, device=state.device)
        return self._moved(state, found[0], action, dt), matrix

    def _moved(self, state, change, action, dt):
        if self.scale is not None:
            change = change * self.scale
        if self.dt_key is not None:  # without an action, dt is the second input
            change = change * (action if dt is None else dt).to(change.dtype).unsqueeze(-2)
        if self.residual:
            return state + change
        return change if self.loc is None else change + self.loc
