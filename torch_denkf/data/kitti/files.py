"""Text files of the KITTI odometry layout.

A pose file has one row a frame: the 3x4 matrix ``[R | t]`` from camera to world coordinates, row by row, in metres.
Camera axes point right, down and forward. Source: Geiger, Lenz & Urtasun 2012, CVPR, and the devkit of the odometry
benchmark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torch_denkf._files import replacing
from torch_denkf.vision.poses import KITTI_DT


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
    with replacing(file) as beside:
        np.savetxt(beside, poses.reshape(len(poses), 12), fmt="%.9e")


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
        return KITTI_DT * np.arange(rows), KITTI_DT
    lines = file.read_text().rstrip().splitlines()
    if len(lines) < rows:
        raise ValueError(f"{file} has {len(lines)} times, but there are {rows} posed frames; add the missing rows")
    numbers = [_numbers(line.split(), 1, f"{file}:{n}", "seconds") for n, line in enumerate(lines, start=1)]
    times = np.concatenate(numbers)
    dt = float(np.median(np.diff(times))) if len(times) > 1 else KITTI_DT
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
