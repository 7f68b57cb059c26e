"""Conversion between camera poses on a car and the planar state of Kloss et al.

A pose is the matrix ``[R | t]`` from camera to world coordinates, ``[3, 4]``, in metres. Camera axes point right, down
and forward. Source: Kloss, Martius & Bohg 2021, arXiv:2012.14313.
"""

from __future__ import annotations

import numpy as np

__all__ = ["KITTI_DT", "poses_to_state", "state_to_poses"]

KITTI_DT = 0.103  # s, the nominal frame time of KITTI's odometry benchmark


def poses_to_state(poses: np.ndarray, dt: float | np.ndarray) -> np.ndarray:
    """Returns the planar state of camera poses, with backward differences.

    Args:
        poses: camera-to-world matrices, ``[N, 3, 4]``, in m.
        dt: time between rows, in s: a number, or ``[N - 1]``.

    Returns:
        ``[N, 5]`` float64: x (camera z) and y (minus camera x) in m, θ in rad, left-positive and unwrapped, v in m/s,
        θ_dot in rad/s. v and θ_dot of row t are the motion from t-1 to t, as the image pair (t-1, t) shows it; row 0
        copies those of row 1, its forward difference. v is the distance in the ground plane over dt, negative if the
        car moves against the mean of both headings.
    """
    x, y = poses[:, 2, 3], -poses[:, 0, 3]
    theta = np.unwrap(-np.arctan2(-poses[:, 2, 0], poses[:, 2, 2]))
    state = np.zeros((len(poses), 5))
    state[:, :3] = np.stack([x, y, theta], -1)
    if len(poses) > 1:
        turn, step = np.diff(theta), np.diff(state[:, :2], axis=0)
        heading = theta[:-1] + turn / 2
        forward = step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)
        state[1:, 3] = np.where(forward < 0, -1.0, 1.0) * np.linalg.norm(step, axis=-1) / dt
        state[1:, 4] = turn / dt
        state[0, 3:] = state[1, 3:]
    return state


def state_to_poses(state: np.ndarray) -> np.ndarray:
    """Returns poses of a level camera: the inverse of :func:`poses_to_state`.

    Args:
        state: ``[N, 3]`` or more columns: x and y in m, θ in rad.

    Returns:
        Camera-to-world matrices, ``[N, 3, 4]``.
    """
    cos, sin = np.cos(state[:, 2]), np.sin(state[:, 2])
    poses = np.zeros((len(state), 3, 4))
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 0, 3] = cos, -sin, -state[:, 1]
    poses[:, 1, 1] = 1.0
    poses[:, 2, 0], poses[:, 2, 2], poses[:, 2, 3] = sin, cos, state[:, 0]
    return poses
