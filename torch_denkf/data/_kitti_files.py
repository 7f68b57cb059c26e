"""Text files of the KITTI odometry layout, and Kloss et al.'s planar state of its camera poses.

A pose file has one row a frame: the 3x4 matrix ``[R | t]`` from camera to world coordinates, row by row, in metres.
Camera axes point right, down and forward. Source: Geiger, Lenz & Urtasun 2012, CVPR, and the devkit of the odometry
benchmark; the state is that of Kloss, Martius & Bohg 2021, arXiv:2012.14313.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

DEFAULT_DT = 0.103  # s, the benchmark's nominal frame time


def read_poses(file: Path) -> np.ndarray:
    """Read a pose file.

    Args:
        file: ``poses/NN.txt``.

    Returns:
        ``[N, 3, 4]`` float64.

    Raises:
        FileNotFoundError: without the file.
        ValueError: naming file and line, where a row is not twelve finite numbers.
    """
    if not file.is_file():
        raise FileNotFoundError(
            f"no poses at {file}; download 'odometry data set (ground truth poses)' from cvlibs.net/datasets/kitti "
            "(sequences 00 to 10 have them) or write the file: a 3x4 camera-to-world matrix a row"
        )
    rows = []
    for number, line in enumerate(file.read_text().rstrip().splitlines(), start=1):
        rows.append(_numbers(line.split(), 12, f"{file}:{number}", "a 3x4 camera-to-world matrix, row by row"))
    if not rows:
        raise ValueError(f"{file} is empty; expected a row of 12 numbers for each frame")
    return np.stack(rows).reshape(-1, 3, 4)


def _numbers(words: list[str], count: int | None, where: str, meaning: str) -> np.ndarray:
    try:
        values = np.array(words, dtype=np.float64)
        good = (count is None or len(values) == count) and bool(np.isfinite(values).all())
    except ValueError:
        good = False
    if not good:
        shown = " ".join(words)[:60]
        raise ValueError(f"{where}: expected {count} finite numbers ({meaning}), got {len(words)} words: {shown!r}")
    return values


def write_poses(file: Path, poses: np.ndarray) -> None:
    """Write camera-to-world matrices ``[N, 3, 4]``, in metres, to a pose file."""
    np.savetxt(file, poses.reshape(len(poses), 12), fmt="%.9e")


def read_times(file: Path, rows: int) -> tuple[np.ndarray, float]:
    """Read the frames' times, or make nominal ones where there is no file.

    Args:
        file: ``sequences/NN/times.txt``.
        rows: how many frames need a time.

    Returns:
        Times in s, ``[rows]``, and the frame time dt in s: the median difference, 0.103 where there is no file.

    Raises:
        ValueError: if the file has fewer rows, or if its times do not increase.
    """
    if not file.is_file():
        return DEFAULT_DT * np.arange(rows), DEFAULT_DT
    lines = file.read_text().rstrip().splitlines()
    if len(lines) < rows:
        raise ValueError(f"{file} has {len(lines)} times, but there are {rows} posed frames; add the missing rows")
    numbers = [_numbers(line.split(), 1, f"{file}:{n}", "seconds") for n, line in enumerate(lines, start=1)]
    times = np.concatenate(numbers)
    dt = float(np.median(np.diff(times))) if len(times) > 1 else DEFAULT_DT
    if dt <= 0:
        raise ValueError(f"{file}: the median difference of its times is {dt} s; expected increasing seconds")
    return times[:rows], dt


def read_calibration(file: Path, camera: str) -> np.ndarray:
    """Read a camera's focal lengths and principal point.

    Args:
        file: ``sequences/NN/calib.txt``, with rows ``P0:`` to ``P3:`` of 3x4 projection matrices.
        camera: folder of the images, ``image_0`` to ``image_3``.

    Returns:
        ``[4]``: fx, fy, cx, cy in pixels of the files.

    Raises:
        FileNotFoundError: without the file.
        ValueError: where the camera's row is missing or malformed.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no calibration at {file}; expected rows 'P0: ...' to 'P3: ...' of 12 numbers")
    key = f"P{camera.removeprefix('image_')}:"
    for number, line in enumerate(file.read_text().splitlines(), start=1):
        words = line.split()
        if words and words[0] == key:
            matrix = _numbers(words[1:], 12, f"{file}:{number}", "a 3x4 projection matrix, row by row")
            return matrix[[0, 5, 2, 6]]
    raise ValueError(f"{file} has no row {key!r}, the projection of {camera}; add it or choose another camera")


def scale_calibration(calibration: np.ndarray, native: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """Scale fx, fy, cx, cy from ``native`` to ``size``, both (H, W), with pixel centres at whole numbers."""
    vertical, horizontal = size[0] / native[0], size[1] / native[1]
    fx, fy, cx, cy = calibration
    return np.array([fx * horizontal, fy * vertical, (cx + 0.5) * horizontal - 0.5, (cy + 0.5) * vertical - 0.5])


def poses_to_state(poses: np.ndarray, dt: float) -> np.ndarray:
    """Planar state of camera poses, with backward differences.

    Args:
        poses: camera-to-world matrices, ``[N, 3, 4]``, in m.
        dt: time between rows, in s.

    Returns:
        ``[N, 5]`` float64: x (camera z) and y (minus camera x) in m, θ in rad, left-positive and unwrapped, v in m/s,
        θ_dot in rad/s. Row t's v and θ_dot are the motion from t-1 to t, so that the image pair (t-1, t) shows them;
        row 0 copies those of row 1, its forward difference. v is the distance in the ground plane over dt, negative
        where the car moves against the mean of both headings.
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
    """Camera poses of a level camera: the inverse of :func:`poses_to_state`.

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
