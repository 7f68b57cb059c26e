"""Trajectory files in KITTI's and TUM's layout, for evo and the benchmarks' tools."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from torch import Tensor

from torch_denkf.applications.car.kitti.files import write_poses
from torch_denkf.applications.car.vision.poses import state_to_poses
from torch_denkf.deployment.files import replacing

__all__ = ["write_trajectory"]

#: First line of a TUM file. Poses that a caller passes have the caller's axes.
_COLUMNS = "time_s x_m y_m z_m qx qy qz qw"
_AXES = "; axes of KITTI's camera: x to the right, y down, z forward"


def write_trajectory(
    file: str | Path,
    trajectory: Tensor | np.ndarray,
    times: Tensor | np.ndarray | None = None,
    *,
    layout: Literal["kitti", "tum"] = "kitti",
) -> Path:
    """Writes a path as a file of camera-to-world poses, in metres.

    A planar state (x, y, θ, ...) becomes the poses of a level camera with KITTI's axes, right, down and forward: the
    forward x of the state is the z of the file, its leftward y is minus the x of the file. Both layouts have the same
    poses, so that files of different layouts can be compared.

    ========= =============================================================================================
    layout    a row of the file
    ========= =============================================================================================
    ``kitti`` the 3x4 matrix [R | t], row by row; no time
    ``tum``   time in s, t as x y z, and R as the unit quaternion qx qy qz qw with qw >= 0; the first line is a
              comment, which names columns, axes and units
    ========= =============================================================================================

    ``evo_ape kitti truth.txt filter.txt --plot --plot_mode xz`` compares two of them.

    Args:
        file: output file; its folder is created.
        trajectory: states ``[T, S]`` that begin with x m, y m and θ rad; or poses ``[T, 3, 4]`` or ``[T, 4, 4]``.
        times: increasing seconds, ``[T]`` or ``[T, 1]``; only needed for ``"tum"``.
        layout: ``"kitti"`` or ``"tum"``.

    Returns:
        The file.

    Raises:
        ValueError: for an unknown layout, shapes that do not match, values that are not finite, and TUM files without
            increasing times.
        OSError: if the file cannot be written, as on a full disk; an existing file is then unchanged.

    Example:
        >>> import tempfile, torch
        >>> state = torch.tensor([[0.0, 0.0, 0.0], [10.0, 1.0, 0.0]])
        >>> file = write_trajectory(f"{tempfile.mkdtemp()}/path.txt", state, torch.tensor([0.0, 0.5]), layout="tum")
        >>> print(file.read_text().splitlines()[-1])
        0.500000000 -1.000000000 0.000000000 10.000000000 0.000000000 0.000000000 0.000000000 1.000000000
    """
    if layout not in ("kitti", "tum"):
        raise ValueError(f'layout must be "kitti" or "tum"; got {layout!r}')
    array = _array(trajectory)
    poses, header = _poses(array), _COLUMNS + (_AXES if array.ndim == 2 else "")
    if not np.isfinite(poses).all():
        row = int(np.flatnonzero(~np.isfinite(poses).all((1, 2)))[0])
        raise ValueError(f"row {row} of the trajectory is not finite; leave such rows out")
    file = Path(file)
    if layout == "kitti":
        write_poses(file, poses)
        return file
    if times is None:
        raise ValueError("a TUM file has a time in each row; pass times")
    seconds = _array(times).reshape(-1)
    if len(seconds) != len(poses) or not (np.diff(seconds) > 0).all() or not np.isfinite(seconds).all():
        raise ValueError(f"times must be {len(poses)} increasing seconds, one a pose; got {len(seconds)}")
    with replacing(file) as beside:
        rows = np.column_stack([seconds, poses[:, :, 3], _quaternions(poses[:, :, :3])]) + 0.0
        np.savetxt(beside, rows, fmt="%.9f", header=header)
    return file


def _array(values: Tensor | np.ndarray) -> np.ndarray:
    array = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
    if array.dtype.kind not in "iufb":
        raise TypeError(f"trajectory and times are arrays of numbers; got {values!r}"[:200])
    return array.astype(np.float64)


def _poses(trajectory: np.ndarray) -> np.ndarray:
    """Returns camera-to-world matrices, ``[T, 3, 4]``."""
    if trajectory.ndim == 3 and trajectory.shape[1:] in ((3, 4), (4, 4)) and len(trajectory):
        return trajectory[:, :3]
    if trajectory.ndim == 2 and trajectory.shape[1] >= 3 and len(trajectory):
        return state_to_poses(trajectory)
    raise ValueError(
        f"a trajectory is states [T, S] with S >= 3, or poses [T, 3, 4] or [T, 4, 4]; got {list(trajectory.shape)}"
    )


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """Returns unit quaternions (x, y, z, w) of rotations ``[T, 3, 3]``.

    Each is the eigenvector of the largest eigenvalue of a symmetric matrix, which is accurate for all rotations and
    finds the nearest one to a matrix with rounding errors. Source: Bar-Itzhack 2000, "New method for extracting the
    quaternion from a rotation matrix", J. Guid. Control Dyn. 23.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotations.reshape(-1, 9).T
    rows = (
        (xx - yy - zz, yx + xy, zx + xz, zy - yz),
        (yx + xy, yy - xx - zz, zy + yz, xz - zx),
        (zx + xz, zy + yz, zz - xx - yy, yx - xy),
        (zy - yz, xz - zx, yx - xy, xx + yy + zz),
    )
    matrices = np.stack([np.stack(row, -1) for row in rows], -2)
    quaternions = np.linalg.eigh(matrices).eigenvectors[:, :, -1]
    return np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)
