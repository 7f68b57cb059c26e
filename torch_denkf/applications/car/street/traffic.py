"""Moving cars: oncoming ones, and cars ahead in the same lane.

They follow the path of the drive at their own speed, so that their image motion differs from the static scene's.
"""

from __future__ import annotations

import numpy as np

from torch_denkf.applications.car.street.path import Path
from torch_denkf.applications.car.street.scene import Mover
from torch_denkf.applications.car.vision.poses import KITTI_DT

SIGHT = 125.0  # m ahead at which cars enter and leave, beyond the drawing distance
BACK = 12.0  # m behind the camera
FAST = 17.0  # m/s: speed of a motorway, whose other lane has the same direction


def traffic(path: Path, cars: list[list[list[np.ndarray]]], rng: np.random.Generator) -> list[Mover]:
    """Returns random traffic of a drive.

    Args:
        path: the path.
        cars: texture pyramids of front, left, rear and right of some cars.
        rng: source of randomness.

    Returns:
        The cars.
    """
    frames = len(path.along)
    speed = np.gradient(path.along, KITTI_DT) if frames > 1 else np.zeros(1)
    moving = speed[speed > 1]
    fast = len(moving) > 0 and float(np.median(moving)) > FAST
    gap, busy = rng.uniform(4, 14), rng.uniform(0.15, 0.6)  # s between oncoming cars; share of time behind a car
    movers = []
    start = rng.exponential(gap)
    while start < KITTI_DT * frames + 5:
        if fast:  # overtakes or is overtaken
            pace = np.median(moving) + rng.choice([-1, 1]) * rng.uniform(1.5, 6)
        else:
            pace = -rng.uniform(6, 15)
        meet = min(round(start / KITTI_DT), frames - 1)
        time = KITTI_DT * np.arange(frames) - start
        along = path.along[meet] + pace * time
        movers += _seen(path, along, 3.5 + rng.normal(0, 0.25), pace, cars[rng.integers(len(cars))], rng)
        start += 1.0 + rng.exponential(gap)
    start = rng.exponential(12)
    while start < KITTI_DT * frames:
        length = rng.uniform(12, 45)
        time = KITTI_DT * np.arange(frames) - start
        movers += _leader(path, time, length, cars[rng.integers(len(cars))], rng)
        start += length + rng.exponential(length * (1 - busy) / busy)
    return movers


def _leader(path: Path, time: np.ndarray, length: float, faces, rng: np.random.Generator) -> list[Mover]:
    """Returns a car ahead, which approaches, stays at a varying distance, and departs."""
    knots = [0.0, *np.arange(rng.uniform(6, 10), length - 6, 5.0), length]
    gaps = [SIGHT, *rng.uniform(8, 40, len(knots) - 2), SIGHT]
    gap = np.interp(time, knots, gaps, left=np.inf, right=np.inf)
    inside = np.isfinite(gap)
    gap[~inside] = SIGHT
    smooth = np.hanning(23)[1:-1]
    gap = np.convolve(np.pad(gap, 10, mode="edge"), smooth / smooth.sum(), mode="valid")
    # A distance that shrinks faster than our speed would let the other car drive backwards.
    along = np.maximum.accumulate(path.along + np.where(inside, gap, SIGHT))
    return _seen(path, np.where(inside, along, np.inf), rng.normal(0, 0.2), 1.0, faces, rng)


def _seen(path: Path, along: np.ndarray, aside: float, pace: float, faces, rng: np.random.Generator) -> list[Mover]:
    """Returns the parts of a car's track near the camera, one for each pass."""
    ahead = along - path.along
    near = np.flatnonzero((ahead > -BACK) & (ahead < SIGHT) & (along > 0) & (along < len(path.line) - 1))
    size = rng.uniform(3.8, 4.9), rng.uniform(1.65, 1.9), rng.uniform(1.4, 1.75)
    movers = []
    for run in np.split(near, np.flatnonzero(np.diff(near) > 1) + 1):
        if len(run):
            track = path.at(along[run], aside)
            track[:, 2:] *= np.sign(pace)
            movers.append(Mover(int(run[0]), track, *size, faces))
    return movers
