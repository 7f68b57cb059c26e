r"""Unicycle model of a vehicle: known motion of the pose, learned change of the velocities (section IV-A)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey
from torch import nn

from torch_denkf.applications.car.modules.pairs import within_pair
from torch_denkf.applications.car.unicycle import unicycle_move
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.modules.tensors import register_location_and_scale
from torch_denkf.modules.transition import MemberNetwork
from torch_denkf.motions.time_step import check_dt, for_members, keys_of_dt
from torch_denkf.submodel import SubModel, Transition

__all__ = ["UnicycleMotion", "UnicycleTransition"]


class UnicycleTransition(MemberNetwork, Transition):
    r"""Known motion of a vehicle, learned change of its velocities (the paper's section IV-A).

    .. math::
        (v, \dot\theta)_t &= (v, \dot\theta)_{t-1} + s \circ f_\theta(((v, \dot\theta)_{t-1} - m) / s) \\
        x_t &= x_{t-1} + v_t \Delta t \cos(\theta_{t-1} + \dot\theta_t \Delta t / 2) \\
        y_t &= y_{t-1} + v_t \Delta t \sin(\theta_{t-1} + \dot\theta_t \Delta t / 2) \\
        \theta_t &= \theta_{t-1} + \dot\theta_t \Delta t

    The pose moves with the *new* velocities, which the image pair (t-1, t) measures: their innovation then corrects the
    pose through the ensemble's covariance.

    Args:
        velocity: maps standardised ``[*, 2]`` velocities to the standardised change ``[*, 2]``.
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        loc: mean of (v, theta_dot), in m/s and rad/s.
        scale: standard deviation of (v, theta_dot), in m/s and rad/s.
        drift: False removes the ensemble's mean change: the velocities are a random walk with learned steps, and do not
            regress to the mean velocities of the training drives without observations.
        history_key: velocities of past steps ``[*B, E, L, 2]``, see
            :func:`torch_denkf.applications.car.modules.pairs.with_history`, L at least 2. The last change of the
            velocities is then extrapolated with a learned factor :math:`\rho` (Gardner's damped trend), as a random
            walk lags behind a braking car.
        in_key: ensemble ``[*B, E, 5]`` of [x m, y m, theta rad, v m/s, theta_dot rad/s].
        out_key: forecast ensemble ``[*B, E, 5]``.

    Raises:
        ValueError: if ``dt`` or ``scale`` is not positive, ``loc`` is not finite, or the state does not have five
            dimensions.

    Example:
        >>> from tensordict import TensorDict
        >>> straight = UnicycleTransition(lambda v: torch.zeros_like(v), dt=0.1)
        >>> td = TensorDict({("belief", "ensemble"): torch.tensor([[0.0, 0.0, 0.0, 10.0, 0.0]])})
        >>> straight(td)["forecast", "ensemble"].tolist()
        [[1.0, 0.0, 0.0, 10.0, 0.0]]
    """

    def __init__(
        self,
        velocity: Callable[..., torch.Tensor],
        dt: float | NestedKey,
        *,
        loc: Sequence[float] | torch.Tensor = (0.0, 0.0),
        scale: Sequence[float] | torch.Tensor = (1.0, 1.0),
        drift: bool = True,
        history_key: NestedKey | None = None,
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        check_dt(dt)
        histories = [] if history_key is None else [history_key]
        super().__init__(velocity, [in_key, *histories, *keys_of_dt(dt)], [out_key])
        self.dt, self.drift = dt, drift
        self.raw_trend = None if history_key is None else nn.Parameter(torch.full((2,), -2.0))
        register_location_and_scale(self, loc, scale)

    def compute(self, state, *others, noise):
        """Returns the forecast ensemble."""
        *history, dt = others if keys_of_dt(self.dt) else (*others, self.dt)
        if state.shape[-1] != 5:
            raise ValueError(
                f"UnicycleTransition moves [x, y, theta, v, theta_dot]; {self.in_keys[0]!r} has "
                f"{state.shape[-1]} state dimensions."
            )
        pose, velocity = state.split([3, 2], -1)
        change = self._run((velocity - self.loc) / self.scale, noise)
        if not self.drift:
            change = change - change.mean(-2, keepdim=True)
        change = self.scale * change
        if self.raw_trend is not None:
            (past,) = history
            change = change + self.raw_trend.sigmoid() * (past[..., 0, :] - past[..., 1, :])
        velocity = velocity + change
        return torch.cat([unicycle_move(pose, velocity, for_members(dt)), velocity], -1)


class UnicycleMotion(SubModel):
    r"""Moves the pose of the last belief with the analysed velocities; put it *after* an :class:`EnsembleAnalysis`.

    The analysis of an ensemble corrects the pose through sample correlations. Over a long drive the members' poses
    spread over many metres, and a spurious correlation of :math:`1/\sqrt{E}` between them and the velocity's innovation
    makes the mean pose jump. This module uses only the velocities of the analysis, and moves each member's pose by the
    known motion, which is localisation in the state: an innovation of the velocities at t acts on the step from t-1 to
    t. After a :class:`PairObservation` it acts on all steps between the two frames; with ``smooth`` on all steps of the
    history, so that a turn that noisy readings reveal late is put at the right place of the path.

    Use with ``EnsembleAnalysis(..., belief_prefix="analysis")``, and not with ``update_at_reset``.

    Args:
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step; with a
            history it must be a number, as all steps must be equal.
        before_key: ensemble of the belief at t-1, ``[*B, E, 5]``, see :class:`UnicycleTransition`.
        analysis_key: ensemble of the analysis at t, ``[*B, E, 5]``, with a history ``[*B, E, 5 + 2L]``.
        belief_prefix: prefix of the outputs: ``ensemble`` ``[*B, E, 5]``, ``mean`` and ``var`` ``[*B, 5]``.
        history_key: velocities of the past steps ``[*B, E, L, 2]``, see :func:`with_history`; ``None`` for none.
        steps_key: optional, with a history: see :class:`PairObservation`.
        smooth: correct the path by each analysis of the history, like a fixed-lag smoother. The first L innovations
            also correct the first pose, in proportion to the uncertainty of the first velocity.

    Raises:
        ValueError: if ``smooth`` is True without a history.

    Source:
        Evensen & van Leeuwen 2000, "An ensemble Kalman smoother for nonlinear dynamics".

    Example:
        >>> from tensordict import TensorDict
        >>> before, analysis = torch.zeros(2, 5), torch.tensor([[9.0, 9.0, 9.0, 10.0, 0.0]] * 2)
        >>> td = TensorDict({"belief": {"ensemble": before}, "analysis": {"ensemble": analysis}})
        >>> UnicycleMotion(0.1)(td)["belief", "mean"].tolist()
        [1.0, 0.0, 0.0, 10.0, 0.0]
    """

    def __init__(
        self,
        dt: float | NestedKey,
        *,
        before_key: NestedKey = ("belief", "ensemble"),
        analysis_key: NestedKey = ("analysis", "ensemble"),
        belief_prefix: str = "belief",
        history_key: NestedKey | None = None,
        steps_key: NestedKey = "steps",
        smooth: bool = False,
    ):
        check_dt(dt)
        if smooth and history_key is None:
            raise ValueError("UnicycleMotion(smooth=True) corrects a history; pass its history_key.")
        histories = [] if history_key is None else [history_key]
        if histories and keys_of_dt(dt):
            raise ValueError(f"UnicycleMotion with a history needs steps of one length; got dt={dt!r}, a key.")
        out_keys = [(belief_prefix, name) for name in ("ensemble", "mean", "var")] + histories
        in_keys = [before_key, analysis_key, *histories, *keys_of_dt(dt)]
        super().__init__(nn.Identity(), in_keys, out_keys, optional_keys=[steps_key] if histories else [])
        self.dt, self.history_key, self.smooth = dt, history_key, smooth

    def compute(self, before, analysis, *others):
        """Returns the belief, and its history."""
        pose, velocity = before[..., :3], analysis[..., 3:5]
        dt = for_members(others[0] if keys_of_dt(self.dt) else self.dt)
        histories: tuple[torch.Tensor, ...] = ()
        if self.history_key is not None:
            history, steps = others
            past = within_pair(steps, history)
            past = torch.ones_like(past) if self.smooth else past
            analysed = analysis[..., 5:].unflatten(-1, (-1, 2))
            corrected = torch.where(past, analysed, history)
            moved = pose
            for step in history.unbind(-2):  # back to the start of the history
                moved = unicycle_move(moved, step, -dt)
            for step in reversed(corrected.unbind(-2)):
                moved = unicycle_move(moved, step, dt)
            # Pairs of neighbours keep the pose exactly, without rounding.
            pose = torch.where(past.flatten(-2).any(-1, keepdim=True), moved, pose)
            histories = (torch.cat([velocity.unsqueeze(-2), analysed[..., :-1, :]], -2),)
        ensemble = torch.cat([unicycle_move(pose, velocity, dt), velocity], -1)
        return ensemble, ensemble_mean(ensemble), ensemble_var(ensemble), *histories
