"""Recorded altitudes, made to agree with where the camera looks."""

from __future__ import annotations

import numpy as np

TOLERANCE = 0.05  # largest difference of the slopes that altitude and attitude show: 2.9 degrees
MOVING = 0.25  # m: steps from which the camera's tilt against the road is told


def steady_altitude(poses: np.ndarray) -> np.ndarray:
    """Takes out climbs that the camera's attitude does not show.

    The altitude of recorded drives is that of a satellite receiver, which drifts while the car stands: at the start of
    the odometry benchmark's drive 08 it climbs by two metres on one metre of the way, with a level camera. A road laid
    under such poses is a wall. Here each step's climb follows, within a tolerance, the slope along which the camera
    looks, plus the camera's tilt against the road, which is the median over the drive.

    Args:
        poses: camera-to-world matrices, ``[N, 3, 4]``, in m; y is down.

    Returns:
        The same poses with other y; where no step is out of tolerance, the same to the last bit.
    """
    step = np.diff(poses[:, :, 3], axis=0)
    way, climb = np.hypot(step[:, 0], step[:, 2]), step[:, 1]
    ahead = (poses[:-1, :, 2] + poses[1:, :, 2]) / 2
    slope = ahead[:, 1] / np.hypot(ahead[:, 0], ahead[:, 2])
    moving = way > MOVING
    tilt = np.median(climb[moving] / way[moving] - slope[moving]) if moving.any() else 0.0
    steady = np.clip(climb, (slope + tilt - TOLERANCE) * way, (slope + tilt + TOLERANCE) * way)
    poses = poses.copy()
    poses[1:, 1, 3] += np.cumsum(steady - climb)
    return poses
