"""Correction of recorded altitudes that contradict the camera's attitude."""

from __future__ import annotations

import numpy as np

TOLERANCE = 0.05  # largest difference of the slopes by altitude and by attitude: 2.9 degrees
MOVING = 0.25  # m: shortest step for estimating the camera's tilt against the road


def steady_altitude(poses: np.ndarray) -> np.ndarray:
    """Removes climbs that contradict the camera's attitude.

    The altitude of recorded drives is from a satellite receiver, and drifts while the car stands: at the start of the
    odometry benchmark's drive 08 it climbs two metres over one metre, with a level camera. A road under such poses
    would be a wall. Here each step's climb is clamped to a tolerance around the slope of the camera's optical axis plus
    the camera's tilt against the road, which is the median over the drive.

    Args:
        poses: camera-to-world matrices, ``[N, 3, 4]``, in m; y is down.

    Returns:
        The poses with corrected y; unchanged if no step is out of tolerance.
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
