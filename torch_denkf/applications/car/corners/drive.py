"""Files of tracked stereo corners and turn rates, as rows of a data set."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf._checks import check_count
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.data import Episode, EpisodeReplay
from torch_denkf.diagnosis.logs import look_at_times

__all__ = ["corner_replay", "read_corner_drive"]

#: Entries of a file, with their shapes.
ENTRIES: dict[str, tuple[tuple, str]] = {
    "features": ((4, "M", "T"), "[4, M, T]"),
    "K": ((3, 3), "[3, 3]"),
    "b": ((), "a number"),
    "cam_T_imu": ((4, 4), "[4, 4]"),
    "rotational_velocity": ((3, "T"), "[3, T]"),
    "time_stamps": ((1, "T"), "[1, T]"),
}
MOST_BYTES = 1 << 31  # size of an unpacked file: ten minutes of a drive have 700 MB
MOST_PIXELS = 1e5  # bound of a corner's coordinates
FASTEST = 40.0  # rad/s: gyroscopes measure up to 35


def read_corner_drive(file: str | Path, rows: int | None = None) -> tuple[TensorDict, StereoCamera]:
    """Returns rows of a drive: the corners that each row shares with the row before, and turn rates.

    A row *repeats* the one before if all shared corners have exactly the same coordinates: the tracker has only
    searched for new corners. Such a row has no information about the motion since the row before, and is not observed.
    At standstill the coordinates differ by noise.

    Args:
        file: npz with ``features`` ``[4, M, T]`` (u left, v left, u right, v right in pixels, -1 if a corner is not
            seen), ``K``, ``b``, ``cam_T_imu``, ``rotational_velocity`` ``[3, T]`` and ``time_stamps`` ``[1, T]``.
        rows: number of rows to read; all by default.

    Returns:
        The rows ``[T]`` in float64, and the camera:

        ===================== ============ =======================================================================
        key                   shape        content
        ===================== ============ =======================================================================
        ``corners``           [T,N,2,4]    in the row before and in this one, pixels; zero-padded
        ``seen``              [T,N]        bool: mask of corners
        ``came_from``         [T,N]        int64: index of the corner in the row before; -1 for a new one
        ``repeats``           [T,N]        int64: number of repeated rows in the corner's track
        ``motion_observed``   [T,1]        bool: there are corners, and the row is no repeat
        ``gyro``              [T,3]        rad/s about the camera's axes
        ``gyro_observed``     [T,1]        bool: True
        ``dt``                [T,1]        s since the row before; in the first row that of the second
        ``time``              [T,1]        s since the first row
        ``step``              [T,1]        int64
        ===================== ============ =======================================================================

    Raises:
        FileNotFoundError: if there is no such file.
        KeyError: if an entry is missing in it.
        ValueError: if the file is damaged, or an entry is not of its shape, not finite, or implausible for a camera,
            rotation or gyroscope; the message names the file and the entry.
    """
    file = Path(file).expanduser()
    entries = _read_entries(file)
    _check_entries(file, entries)
    features, matrix, baseline, to_camera, rates, stamps = entries.values()
    if rows is not None:
        check_count("rows", rows, least=2, most=features.shape[-1], cure=f"{file} has {features.shape[-1]}")
    count = features.shape[-1] if rows is None else rows
    look_at_times(stamps[0], file, "time_stamps", None)
    features = features[..., :count]
    pairs = _pairs(features)
    time = torch.as_tensor(stamps[0, :count] - stamps[0, 0]).unsqueeze(-1)
    steps = time.diff(dim=0)
    gyro = torch.as_tensor(rates[:, :count].T @ to_camera[:3, :3].T)
    again = pairs.pop("again")
    data = TensorDict({**pairs, "gyro": gyro, "time": time}, [count])
    data["motion_observed"] = data["seen"].any(-1, keepdim=True) & ~again.unsqueeze(-1)
    data["gyro_observed"] = torch.ones(count, 1, dtype=torch.bool)
    data["dt"] = torch.cat([steps[:1], steps])
    data["step"] = torch.arange(count).unsqueeze(-1)
    return data, StereoCamera(float(matrix[0, 0]), (float(matrix[0, 2]), float(matrix[1, 2])), float(baseline))


def corner_replay(drives: dict[str, TensorDict], **options) -> EpisodeReplay:
    """Returns drives as episodes of one data set for :class:`~torch_denkf.envs.ReplayEnv`, without a test split.

    Args:
        drives: rows ``[T]`` with the inputs of a filter, by the name of the drive.
        **options: of :class:`~torch_denkf.data.EpisodeReplay`.

    Raises:
        ValueError: without drives.
    """
    if not drives:
        raise ValueError("drives is empty; pass rows by the name of the drive")
    episodes, begin = [], 0
    for name, rows in drives.items():
        episodes.append(Episode(name, begin, len(rows)))
        begin += len(rows)
    rows = torch.cat(list(drives.values()))
    return EpisodeReplay(rows, episodes, for_tests=lambda episode: False, **options)


def _read_entries(file: Path) -> dict[str, np.ndarray]:
    if not file.is_file():
        raise FileNotFoundError(f"no file {file}; check the path")
    damaged = f"{file} is no npz file of numbers ({{}}); download or copy it again"
    try:
        with zipfile.ZipFile(file) as archive:
            if (size := sum(part.file_size for part in archive.infolist())) > MOST_BYTES:
                raise ValueError(f"it announces {size} bytes")
        with np.load(file) as stored:
            if missing := [name for name in ENTRIES if name not in stored.files]:
                raise KeyError(f"{file} has no {missing}; it has {stored.files}. It should hold {list(ENTRIES)}")
            return {name: stored[name].astype(np.float64, casting="same_kind") for name in ENTRIES}
    except (ValueError, TypeError, OSError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(damaged.format(error)) from error


def _check_entries(file: Path, entries: dict[str, np.ndarray]) -> None:
    count = entries["features"].shape[-1] if entries["features"].ndim == 3 else 0
    for name, (shape, layout) in ENTRIES.items():
        value = entries[name]
        expected = tuple({"M": value.shape[1] if value.ndim == 3 else 0, "T": count}.get(side, side) for side in shape)
        if value.shape != expected:
            raise ValueError(f"{file}: {name!r} must be {layout}, T = {count}; got {list(value.shape)}")
        if not np.isfinite(value).all():
            raise ValueError(f"{file}: {name!r} holds NaN or infinity; only a corner that is not seen has -1")
    features, matrix, baseline, to_camera, rates, stamps = entries.values()
    there = (features != -1).all(0)
    turn, focal = to_camera[:3, :3], matrix[0, 0]
    sound = {
        "time_stamps": ((np.diff(stamps[0]) > 0).all(), "ascend from row to row"),
        "features": (count > 1 and there.any(), "hold corners, in two rows at least"),
        "K": (
            focal > 0 and np.allclose(matrix, [[focal, 0, matrix[0, 2]], [0, focal, matrix[1, 2]], [0, 0, 1]], 1e-3),
            "be [[f, 0, u], [0, f, v], [0, 0, 1]], of rectified images",
        ),
        "b": (0 < baseline <= 10, "be the distance of the lenses in m"),
        "cam_T_imu": (
            np.allclose(turn @ turn.T, np.eye(3), 0, 1e-3) and np.linalg.det(turn) > 0,
            "turn from the inertial sensor's axes to the camera's: no rotation stands in it",
        ),
        "rotational_velocity": (np.abs(rates).max(initial=0) < FASTEST, f"be in rad/s, below {FASTEST:g}"),
    }
    for name, (right, what) in sound.items():
        if not right:
            raise ValueError(f"{file}: {name!r} must {what}")
    seen = features[:, there]
    if seen.min() < -1 or seen.max() > MOST_PIXELS:
        raise ValueError(f"{file}: 'features' must be pixels, -1 where not seen; got {seen.min():g} to {seen.max():g}")
    if np.median(seen[0] - seen[2]) < 0:
        raise ValueError(f"{file}: 'features' must be u left, v left, u right, v right; most disparities are negative")


def _pairs(features: np.ndarray) -> dict[str, Tensor]:
    """Returns corners of neighbouring rows with the keys of :func:`read_corner_drive`, and the mask of repeats."""
    there = (features != -1).all(0)
    both = there[:, 1:] & there[:, :-1]
    most, count, tracks = max(int(both.sum(0).max()), 1), features.shape[-1], len(there)
    corners, seen = np.zeros((count, most, 2, 4)), np.zeros((count, most), bool)
    came_from, repeats = np.full((count, most), -1), np.zeros((count, most), int)
    again, survived = np.zeros(count, bool), np.zeros(tracks, int)
    places = np.full(tracks, -1)  # index of each track in the row before
    for row in range(1, count):
        which = np.flatnonzero(both[:, row - 1])
        pair = features[:, which, row - 1 : row + 1].transpose(1, 2, 0)
        corners[row, : len(which)], seen[row, : len(which)] = pair, True
        again[row] = len(which) > 0 and bool((pair[:, 0] == pair[:, 1]).all())
        survived[which] += again[row]
        came_from[row, : len(which)], repeats[row, : len(which)] = places[which], survived[which]
        places[:] = -1
        if not again[row]:  # after a repeat, a track is another point of the world
            places[which] = np.arange(len(which))
    found = {"corners": corners, "seen": seen, "came_from": came_from, "repeats": repeats, "again": again}
    return {key: torch.as_tensor(value) for key, value in found.items()}
