"""Text files of the KITTI odometry layout.

A pose file has one row a frame: the 3x4 matrix ``[R | t]`` from camera to world coordinates, row by row, in metres.
Camera axes point right, down and forward. Source: Geiger, Lenz & Urtasun 2012, CVPR, and the devkit of the odometry
benchmark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torch_denkf.data.text import read_lines, read_number
from torch_denkf.deployment.files import replacing

FARTHEST = 1e6  # m from the origin: float32, the dtype of states, then resolves 6 cm
LONGEST_FOCAL = 1e6  # pixels: a view of a minute of arc
ROTATION = 0.01  # largest deviation of R R^T from I; files with two digits pass
FASTEST = 300.0  # m/s: beyond any car


def read_poses(file: Path) -> np.ndarray:
    """Reads a pose file.

    Args:
        file: ``poses/NN.txt``.

    Returns:
        ``[N, 3, 4]`` float64.

    Raises:
        FileNotFoundError: without the file.
        ValueError: if a row is not twelve finite numbers, its first three columns are no rotation, or its position is
            farther than 1000 km from the origin; the message names file and line.
    """
    if not file.is_file():
        raise FileNotFoundError(
            f"no poses at {file}; download 'odometry data set (ground truth poses)' from cvlibs.net/datasets/kitti "
            "(sequences 00 to 10 have them) or write the file: a 3x4 camera-to-world matrix a row"
        )
    rows = []
    lines = read_lines(file)
    while lines and not lines[-1].strip():
        lines.pop()
    for number, line in enumerate(lines, start=1):
        rows.append(_numbers(line.split(), 12, f"{file}:{number}", "a 3x4 camera-to-world matrix, row by row"))
    if not rows:
        raise ValueError(f"{file} is empty; expected a row of 12 numbers for each frame")
    poses = np.stack(rows).reshape(-1, 3, 4)
    _check_poses(file, poses)
    return poses


def _check_poses(file: Path, poses: np.ndarray) -> None:
    far = np.abs(poses[:, :, 3]).max(-1)
    if (far > FARTHEST).any():
        row = int(np.flatnonzero(far > FARTHEST)[0])
        raise ValueError(
            f"{file}:{row + 1}: the position {far[row]:g} m is farther than {FARTHEST:g} m from the origin; write "
            "metres, and subtract the first position"
        )
    large = np.abs(poses[:, :, :3]).max((1, 2)) > 2  # their squares may overflow
    rotations = np.where(large[:, None, None], 0, poses[:, :, :3])
    away = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    turned = np.linalg.det(rotations)
    wrong = np.flatnonzero(large | (away > ROTATION) | (turned < 0))
    if len(wrong):
        row = int(wrong[0])
        what = (
            f"is mirrored (its determinant is {turned[row]:.3g})"
            if away[row] <= ROTATION
            else f"is no rotation: {' '.join(f'{value:g}' for value in poses[row, :, :3].ravel())}"
        )
        raise ValueError(
            f"{file}:{row + 1}: the matrix R {what}, in {len(wrong)} of {len(poses)} rows; a row is [R | t], camera to "
            "world, row by row, with R R^T = I and determinant 1. Take drives without poses out of the folder, or "
            "orthonormalise R"
        )


def check_speeds(file: Path, poses: np.ndarray, dt: np.ndarray) -> None:
    """Checks that no two successive poses imply an impossible speed.

    Args:
        file: file of the poses, for the message.
        poses: ``[N, 3, 4]``, of its first rows.
        dt: s between successive poses, ``[N - 1]``.

    Raises:
        ValueError: if a speed exceeds 300 m/s; the message names file and line.
    """
    ways = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=-1)
    wrong = np.flatnonzero(ways > FASTEST * dt)
    if len(wrong):
        row = int(wrong[0])
        raise ValueError(
            f"{file}:{row + 2}: the position is {ways[row]:g} m from that of the row before, {dt[row]:g} s earlier; "
            f"expected metres, and at most {FASTEST:g} m/s. Correct the row, or write the poses again"
        )


def _numbers(words: list[str], count: int | None, where: str, meaning: str) -> np.ndarray:
    try:
        values = np.array([read_number(word) for word in words])
        good = (count is None or len(values) == count) and bool(np.isfinite(values).all())
    except ValueError:
        good = False
    if not good:
        shown = " ".join(words)[:60]
        raise ValueError(f"{where}: expected {count} finite numbers ({meaning}), got {len(words)} words: {shown!r}")
    return values


def write_poses(file: Path, poses: np.ndarray) -> None:
    """Writes camera-to-world matrices ``[N, 3, 4]``, in metres, to a pose file."""
    with replacing(file) as beside:
        np.savetxt(beside, poses.reshape(len(poses), 12), fmt="%.9e")


def read_calibration(file: Path, camera: str) -> np.ndarray:
    """Reads a camera's focal lengths and principal point.

    Args:
        file: ``sequences/NN/calib.txt``, with rows ``P0:`` to ``P3:`` of 3x4 projection matrices.
        camera: folder of the images, ``image_0`` to ``image_3``.

    Returns:
        ``[4]``: fx, fy, cx, cy in pixels of the files.

    Raises:
        FileNotFoundError: without the file.
        ValueError: if the camera's row is missing, duplicated or malformed, a focal length is not positive, or the
            numbers are impossible for a camera.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no calibration at {file}; expected rows 'P0: ...' to 'P3: ...' of 12 numbers")
    key = f"P{camera.removeprefix('image_')}:"
    rows = [(number, line.split()) for number, line in enumerate(read_lines(file), start=1)]
    rows = [(number, words[1:]) for number, words in rows if words and words[0] == key]
    if not rows:
        raise ValueError(f"{file} has no row {key!r}, the projection of {camera}; add it or choose another camera")
    number, words = rows[-1]
    if len(rows) > 1:
        raise ValueError(f"{file}:{number}: {key!r} is there {len(rows)} times; keep the row of this drive's camera")
    matrix = _numbers(words, 12, f"{file}:{number}", "a 3x4 projection matrix, row by row")
    if not 0 < min(matrix[0], matrix[5]) <= max(matrix[0], matrix[5]) <= LONGEST_FOCAL:
        raise ValueError(
            f"{file}:{number}: the focal lengths fx and fy must be positive pixels, up to {LONGEST_FOCAL:g}, "
            f"got {matrix[0]:g} and {matrix[5]:g}; they are the first and the sixth number of {key!r}"
        )
    if max(abs(matrix[2]), abs(matrix[6])) > LONGEST_FOCAL:
        raise ValueError(
            f"{file}:{number}: the principal point ({matrix[2]:g}, {matrix[6]:g}) is in pixels, up to "
            f"{LONGEST_FOCAL:g} from the corner; cx and cy are the third and the seventh number of {key!r}"
        )
    return matrix[[0, 5, 2, 6]]


def scale_calibration(calibration: np.ndarray, native: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """Scales fx, fy, cx, cy from ``native`` to ``size``, both (H, W), with pixel centres at whole numbers."""
    vertical, horizontal = size[0] / native[0], size[1] / native[1]
    fx, fy, cx, cy = calibration
    return np.array([fx * horizontal, fy * vertical, (cx + 0.5) * horizontal - 0.5, (cy + 0.5) * vertical - 0.5])
