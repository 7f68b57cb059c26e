"""Integrates a network's velocity estimates to a vehicle's pose."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import nn

from torch_denkf.applications.car.unicycle import unicycle_jacobians, unicycle_move
from torch_denkf.motions.time_step import check_dt, keys_of_dt
from torch_denkf.submodel import SubModel

__all__ = ["UnicyclePose"]


class UnicyclePose(SubModel):
    r"""Integrates estimated velocities to a vehicle's pose by the known motion, which need not be learned.

    .. math::
        p_t = f(p_{t-1}, u_t), \qquad
        P_t = F P_{t-1} F^T + G \Sigma_t G^T, \qquad
        \mathrm{Cov}(p_t, u_t) = G \Sigma_t

    with the motion f of :class:`UnicycleTransition`, its Jacobians F and G, and velocities :math:`u_t \sim N(\mu_t,
    \Sigma_t)`. The covariance is of first order, for independent errors of the velocities at different times: with
    correlated errors (a biased network) it is too small.

    Args:
        dt: time step in seconds, or the key of an entry ``[*B, 1]`` with the seconds since the last step.
        velocity_prefix: prefix of ``mean`` ``[*B, 2]`` and ``cov`` ``[*B, 2, 2]`` of (v m/s, theta_dot rad/s) at t.
        forecast_prefix: prefix of ``mean`` ``[*B, 5]`` and ``cov`` of [x m, y m, theta rad, v, theta_dot] at t-1, as
            :class:`LSTMTransition` writes them.
        belief_prefix: prefix of the outputs ``mean``, ``cov`` and ``var`` at t.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({
        ...     "forecast": {"mean": torch.zeros(5), "cov": torch.zeros(5, 5)},
        ...     "velocity": {"mean": torch.tensor([10.0, 0.0]), "cov": torch.eye(2)},
        ... })
        >>> td = UnicyclePose(0.1)(td)
        >>> td["belief", "mean"].tolist(), td["belief", "var"].tolist()
        ([1.0, 0.0, 0.0, 10.0, 0.0], [0.01..., 0.0025..., 0.01..., 1.0, 1.0])
    """

    velocity_dim = 2

    def __init__(
        self,
        dt: float | NestedKey,
        *,
        velocity_prefix: str = "velocity",
        forecast_prefix: str = "forecast",
        belief_prefix: str = "belief",
    ):
        check_dt(dt)
        in_keys = [(key, name) for key in (forecast_prefix, velocity_prefix) for name in ("mean", "cov")] + keys_of_dt(
            dt
        )
        super().__init__(nn.Identity(), in_keys, [(belief_prefix, name) for name in ("mean", "cov", "var")])
        self.dt = dt

    def compute(self, mean, cov, velocity, velocity_cov, dt=None):
        """Returns the belief."""
        pose, dt = mean[..., :3], self.dt if dt is None else dt
        by_pose, by_velocity = unicycle_jacobians(pose, velocity, dt)
        cross = by_velocity @ velocity_cov
        pose_cov = by_pose @ cov[..., :3, :3] @ by_pose.mT + cross @ by_velocity.mT
        cov = torch.cat([torch.cat([pose_cov, cross], -1), torch.cat([cross.mT, velocity_cov], -1)], -2)
        moved = unicycle_move(pose, velocity, dt)
        return torch.cat([moved, velocity], -1), cov, cov.diagonal(dim1=-2, dim2=-1)
