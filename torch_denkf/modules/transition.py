r"""Transition models: forecast :math:`x^i_{t|t-1} \sim f_\theta(x^i_{t-1|t-1})` (the paper's eq. 5)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import nn

from torch_denkf.functional import ensemble_mean, ensemble_var
from torch_denkf.modules._base import SubModel
from torch_denkf.modules.stochastic import StochasticMLP

__all__ = ["LearnedTransition", "UnicycleMotion", "UnicycleTransition"]


class _StochasticTransition(SubModel):
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


class LearnedTransition(_StochasticTransition):
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


class UnicycleTransition(_StochasticTransition):
    r"""Known motion of a vehicle, learned change of its velocities (the paper's section IV-A).

    .. math::
        (v, \dot\theta)_t &= (v, \dot\theta)_{t-1} + s \circ f_\theta(((v, \dot\theta)_{t-1} - m) / s) \\
        x_t &= x_{t-1} + v_t \Delta t \cos(\theta_{t-1} + \dot\theta_t \Delta t / 2) \\
        y_t &= y_{t-1} + v_t \Delta t \sin(\theta_{t-1} + \dot\theta_t \Delta t / 2) \\
        \theta_t &= \theta_{t-1} + \dot\theta_t \Delta t

    The pose moves with the *new* velocities, because those are what the image pair (t-1, t) measures: their
    innovation then corrects the pose through the ensemble's covariance.

    Args:
        velocity: maps standardised ``[*, 2]`` velocities to the standardised change ``[*, 2]``.
        dt: time step in seconds.
        loc: mean of (v, theta_dot), in m/s and rad/s.
        scale: standard deviation of (v, theta_dot), in m/s and rad/s.
        drift: False takes the ensemble's mean change away: the velocities walk at random, with learned steps, and a
            network trained on few drives cannot make them return to those drives' usual ones where nothing is observed.
        ensemble_size: see :class:`LearnedTransition`.
        in_key: ensemble ``[*B, E, 5]`` of [x m, y m, theta rad, v m/s, theta_dot rad/s].
        out_key: forecast ensemble ``[*B, E, 5]``.
        noise_key: optional noise (see :class:`StochasticMLP`).

    Raises:
        ValueError: if the state does not have five dimensions.

    Example:
        >>> from tensordict import TensorDict
        >>> straight = UnicycleTransition(lambda v: torch.zeros_like(v), dt=0.1)
        >>> td = TensorDict({("belief", "ensemble"): torch.tensor([[0.0, 0.0, 0.0, 10.0, 0.0]])})
        >>> straight(td)["forecast", "ensemble"].tolist()
        [[1.0, 0.0, 0.0, 10.0, 0.0]]
    """

    def __init__(
        self,
        velocity: nn.Module,
        dt: float,
        *,
        loc: Sequence[float] | torch.Tensor = (0.0, 0.0),
        scale: Sequence[float] | torch.Tensor = (1.0, 1.0),
        drift: bool = True,
        ensemble_size: int | None = None,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
        noise_key: NestedKey = ("noise", "transition"),
    ):
        super().__init__(velocity, [in_key], [out_key], ensemble_size, noise_key)
        self.dt, self.drift = dt, drift
        self.register_buffer("loc", torch.as_tensor(loc, dtype=torch.get_default_dtype()))
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.get_default_dtype()))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the forecast ensemble."""
        state = self.read(tensordict, self.in_keys[0])
        if state.shape[-1] != 5:
            raise ValueError(
                f"UnicycleTransition moves [x, y, theta, v, theta_dot]; {self.in_keys[0]!r} has "
                f"{state.shape[-1]} state dimensions."
            )
        pose, velocity = state.split([3, 2], -1)
        change = self._run((velocity - self.loc) / self.scale, tensordict)
        if not self.drift:
            change = change - change.mean(-2, keepdim=True)
        velocity = velocity + self.scale * change
        tensordict.set(self.out_keys[0], _move(pose, velocity, self.dt))
        return tensordict


class UnicycleMotion(SubModel):
    r"""Moves the pose of the last belief with the velocities of the analysis, put *after* an :class:`EnsembleAnalysis`.

    The analysis of an ensemble corrects the pose through sample correlations. Over a long drive the members' poses
    spread over many metres, and a spurious correlation of :math:`1/\sqrt{E}` between them and the velocity's
    innovation makes the mean pose jump. This module takes from the analysis the velocities alone and lets the known
    motion carry each member's pose, which is localisation in the state: an innovation of the velocities at t acts on
    the step from t-1 to t.

    Use with ``EnsembleAnalysis(..., belief_key="analysis")``, and not with ``update_at_reset``.

    Args:
        dt: time step in seconds.
        before_key: ensemble of the belief at t-1, ``[*B, E, 5]``, see :class:`UnicycleTransition`.
        analysis_key: ensemble of the analysis at t, ``[*B, E, 5]``.
        belief_key: prefix of what is written: ``ensemble`` ``[*B, E, 5]``, ``mean`` and ``var`` ``[*B, 5]``.

    Example:
        >>> from tensordict import TensorDict
        >>> before, analysis = torch.zeros(2, 5), torch.tensor([[9.0, 9.0, 9.0, 10.0, 0.0]] * 2)
        >>> td = TensorDict({"belief": {"ensemble": before}, "analysis": {"ensemble": analysis}})
        >>> UnicycleMotion(0.1)(td)["belief", "mean"].tolist()
        [1.0, 0.0, 0.0, 10.0, 0.0]
    """

    def __init__(
        self,
        dt: float,
        *,
        before_key: NestedKey = ("belief", "ensemble"),
        analysis_key: NestedKey = ("analysis", "ensemble"),
        belief_key: str = "belief",
    ):
        out_keys = [(belief_key, name) for name in ("ensemble", "mean", "var")]
        super().__init__(nn.Identity(), [before_key, analysis_key], out_keys)
        self.dt = dt

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the belief."""
        before, analysis = (self.read(tensordict, key) for key in self.in_keys)
        ensemble = _move(before[..., :3], analysis[..., 3:], self.dt)
        values = (ensemble, ensemble_mean(ensemble), ensemble_var(ensemble))
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value)
        return tensordict


def _move(pose: torch.Tensor, velocity: torch.Tensor, dt: float) -> torch.Tensor:
    """The state [x, y, theta, v, theta_dot] after ``dt`` at constant ``velocity``, with the heading at mid-step."""
    step = velocity * dt
    heading = pose[..., 2] + 0.5 * step[..., 1]
    moved = torch.stack([step[..., 0] * heading.cos(), step[..., 0] * heading.sin(), step[..., 1]], -1)
    return torch.cat([pose + moved, velocity], -1)
