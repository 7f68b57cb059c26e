r"""Unicycle motion of a vehicle on the plane: a pose moves with speed and turn rate along the mid-step heading."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def unicycle_move(pose: Tensor, velocity: Tensor, dt: float | Tensor) -> Tensor:
    r"""Moves poses for one step (the paper's section IV-A).

    .. math::
        x' = x + v\,\Delta t \cos(\theta + \dot\theta \Delta t / 2), \quad
        y' = y + v\,\Delta t \sin(\theta + \dot\theta \Delta t / 2), \quad
        \theta' = \theta + \dot\theta \Delta t

    The call with ``-dt`` is the inverse, up to rounding.

    Args:
        pose: (x m, y m, theta rad), ``[*, 3]``.
        velocity: (v m/s, theta_dot rad/s), ``[*, 2]``.
        dt: time step in s, a number or ``[*, 1]``.

    Returns:
        The poses afterwards, ``[*, 3]``; theta is not wrapped.

    Examples:
        >>> unicycle_move(torch.zeros(3), torch.tensor([10.0, 0.0]), 0.1)
        tensor([1., 0., 0.])
    """
    step = velocity * dt
    heading = pose[..., 2] + 0.5 * step[..., 1]
    moved = torch.stack([step[..., 0] * heading.cos(), step[..., 0] * heading.sin(), step[..., 1]], -1)
    return pose + moved


def unicycle_jacobians(pose: Tensor, velocity: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor]:
    """Returns the Jacobians of :func:`unicycle_move`.

    Args:
        pose: (x m, y m, theta rad) before the step, ``[*, 3]``.
        velocity: (v m/s, theta_dot rad/s), ``[*, 2]``.
        dt: time step in s, a number or ``[*, 1]``.

    Returns:
        Derivatives with respect to the pose ``[*, 3, 3]`` and the velocity ``[*, 3, 2]``.

    Examples:
        >>> unicycle_jacobians(torch.zeros(3), torch.tensor([10.0, 0.0]), 0.1)[1]
        tensor([[0.1000, -0.0000],
                [0.0000, 0.0500],
                [0.0000, 0.1000]])
    """
    dt = dt[..., 0] if isinstance(dt, Tensor) else dt
    heading = pose[..., 2] + 0.5 * dt * velocity[..., 1]
    cos, sin, way = heading.cos(), heading.sin(), dt * velocity[..., 0]
    zero, one = torch.zeros_like(way), torch.ones_like(way)
    by_pose = [[one, zero, -way * sin], [zero, one, way * cos], [zero, zero, one]]
    by_velocity = [[dt * cos, -0.5 * dt * way * sin], [dt * sin, 0.5 * dt * way * cos], [zero, dt * one]]
    return _matrix(by_pose), _matrix(by_velocity)


def _matrix(rows: Sequence[Sequence[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(tuple(row), -1) for row in rows], -2)
