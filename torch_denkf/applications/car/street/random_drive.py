"""Random drives: planar motion of a car, hills, and pitch and roll of its body."""

from __future__ import annotations

import numpy as np

from torch_denkf.applications.car.vision.poses import KITTI_DT, state_to_poses

LOOKS_DOWN = 0.0185  # rad: downward pitch of the odometry drives' cameras


def random_drive(frames: int, rng: np.random.Generator, dt: float = KITTI_DT) -> np.ndarray:
    """Returns a smooth random drive.

    The speed is 0 to 15 m/s with few stops; the car accelerates by about 1 m/s², brakes by at most 2 m/s², and is slow
    in sharp bends: the turn rate stays below 0.5 rad/s and the lateral acceleration at about 2.5 m/s².

    Args:
        frames: rows, N.
        rng: source of randomness.
        dt: time between rows in s.

    Returns:
        The state ``[N, 5]``, as :func:`torch_denkf.applications.car.read_kitti_drive` defines it; it starts at the
        origin, and row t is computed from row t-1 by v_t, θ_dot_t and the mean heading.
    """
    time = dt * np.arange(frames)
    bend = 0.004 * np.interp(time, *_knots(rng, time[-1], (3, 6), lambda: rng.standard_normal()))  # 1/m
    start = rng.uniform(2, 8)
    while start < time[-1]:
        width, radius = rng.uniform(3, 6), rng.uniform(9, 40)
        inside = np.abs(time - start) < width / 2
        bump = 0.5 + 0.5 * np.cos(2 * np.pi * (time - start) / width)
        bend = bend + np.where(inside, rng.choice([-1, 1]) * bump / radius, 0)
        start += width + rng.exponential(7)
    limit = np.minimum(0.5 / np.maximum(np.abs(bend), 1e-6), np.sqrt(2.5 / np.maximum(np.abs(bend), 1e-6)))

    def wish() -> float:
        return 0.0 if rng.random() < 0.08 else rng.uniform(3, 15)

    target = np.minimum(np.interp(time, *_knots(rng, time[-1], (3, 8), wish)), limit)
    for t in range(frames - 2, -1, -1):  # brake early enough
        target[t] = min(target[t], target[t + 1] + 2.0 * dt)
    for t in range(1, frames):
        target[t] = min(target[t], target[t - 1] + 1.2 * dt)
    half = round(0.5 / dt)  # smooth over a second
    padded = np.pad(target, half, mode="edge")
    speed = np.convolve(padded, np.hanning(2 * half + 3)[1:-1] / (half + 1), mode="valid")
    turn = np.clip(bend * speed, -0.5, 0.5)
    speed[0], turn[0] = speed[1:2].item(), turn[1:2].item()
    theta = np.concatenate([[0], np.cumsum(turn[1:] * dt)])
    heading = theta[1:] - turn[1:] * dt / 2
    step = np.stack([np.cos(heading), np.sin(heading)], -1) * speed[1:, None] * dt
    return np.column_stack([np.concatenate([np.zeros((1, 2)), step.cumsum(0)]), theta, speed, turn])


def _knots(rng: np.random.Generator, end: float, gap: tuple[float, float], draw) -> tuple[list[float], list[float]]:
    times, values = [0.0], [draw()]
    while times[-1] < end:
        times.append(times[-1] + rng.uniform(*gap))
        values.append(draw())
    return times, values


def hilly_poses(state: np.ndarray, rng: np.random.Generator, dt: float = KITTI_DT) -> np.ndarray:
    """Returns camera poses of a drive over hills, with pitch and roll of the car.

    Slopes are up to about 6 %; the body pitches by 0.3° and rolls by 0.5° (standard deviations), and the camera has a
    downward pitch of 1.06° as in KITTI's odometry drives.

    Args:
        state: x and y in m, θ in rad in its first three columns, ``[N, 3]``.
        rng: source of randomness.
        dt: time between rows in s.

    Returns:
        Camera-to-world matrices, ``[N, 3, 4]``; the first camera is at the origin.
    """
    frames, time = len(state), dt * np.arange(len(state))
    step = np.linalg.norm(np.diff(state[:, :2], axis=0), axis=-1)
    along = np.concatenate([[0], np.cumsum(step)])
    metres = np.arange(0, along[-1] + 2)
    knots = _knots(rng, metres[-1], (60, 200), lambda: np.clip(0.025 * rng.standard_normal(), -0.06, 0.06))
    width = np.hanning(43)[1:-1]
    slopes = np.convolve(np.pad(np.interp(metres, *knots), 20, mode="edge"), width / width.sum(), mode="valid")
    slope = np.interp(along, metres, slopes)
    climb = np.interp(along, metres, np.concatenate([[0], np.cumsum((slopes[1:] + slopes[:-1]) / 2)]))

    def sway(deviation: float, gap: tuple[float, float]) -> np.ndarray:  # smooth over a few frames
        rough = np.interp(time, *_knots(rng, time[-1], gap, lambda: deviation * rng.standard_normal()))
        return np.convolve(np.pad(rough, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")

    pitch = np.arctan(slope) - LOOKS_DOWN + sway(0.005, (0.4, 1.2))  # nose up
    roll = sway(0.009, (0.8, 3.0))
    poses = state_to_poses(state)
    turn = np.zeros((2, frames, 3, 3))
    turn[:, :, range(3), range(3)] = 1
    turn[0, :, 1, 1] = turn[0, :, 2, 2] = np.cos(pitch)
    turn[0, :, 2, 1], turn[0, :, 1, 2] = np.sin(pitch), -np.sin(pitch)
    turn[1, :, 0, 0] = turn[1, :, 1, 1] = np.cos(roll)
    turn[1, :, 1, 0], turn[1, :, 0, 1] = np.sin(roll), -np.sin(roll)
    poses[:, :, :3] = poses[:, :, :3] @ turn[0] @ turn[1]
    poses[:, 1, 3] = -climb
    return poses
