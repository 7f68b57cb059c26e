"""Two drives of KITTI as rows of readings: sequence 07, and a drive without poses for the choice of all settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.sequence07.chosen import CAMERA, CORNERS
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.drive import read_corner_drive
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motions
from torch_denkf.applications.car.kitti.files import read_poses
from torch_denkf.functional.manifolds import SE3, quaternion_of

__all__ = ["CONDITIONS", "ROWS", "Condition", "chained", "drive", "naive", "readings", "truth"]

ROWS = 1101  # of the raw drive that sequence 07 has
Condition = Literal["recorded", "dropout", "outliers"]
CONDITIONS: tuple[Condition, ...] = get_args(Condition)
LOST, EVERY = 10, 100  # rows without corners, 1 s, in each 10 s
WRONG, OFF = 0.2, 30.0  # share of outliers; their largest error in each direction, in pixels, uniformly distributed


@dataclass(frozen=True)
class Drive:
    """Rows and camera of a drive."""

    rows: TensorDict
    camera: StereoCamera


@cache
def drive(folder: Path, name: str, count: int | None = None) -> Drive:
    """Returns the rows of ``kitti_inertial/NAME.npz`` in a folder, and its calibrated camera."""
    return Drive(*read_corner_drive(folder / "kitti_inertial" / f"{name}.npz", count))


@cache
def truth(folder: Path, count: int = ROWS) -> Tensor:
    """Returns the official poses of sequence 07, ``[T, 7]``, of the left camera."""
    poses = torch.as_tensor(read_poses(folder / "kitti" / "poses" / "07.txt"), dtype=torch.float64)[:count]
    return torch.cat([quaternion_of(poses[:, :3, :3]), poses[:, :3, 3]], -1)


def calibrated(camera: StereoCamera) -> StereoCamera:
    """Returns the camera with the estimated lens distortion and disparity offset."""
    return replace(camera, radial=CAMERA["radial"], disparity_offset=CAMERA["disparity_offset"])


def with_outliers(rows: TensorDict, seed: int) -> TensorDict:
    """Returns rows in which some corners of the later row are displaced, by different amounts in both images."""
    random = torch.Generator().manual_seed(seed)
    wrong = torch.rand(rows["seen"].shape, generator=random) < WRONG
    away = OFF * (2 * torch.rand(*wrong.shape, 4, generator=random, dtype=torch.float64) - 1)
    rows = rows.clone()
    rows["corners"][:, :, 1] += torch.where((wrong & rows["seen"]).unsqueeze(-1), away, 0.0)
    return rows


def in_condition(rows: TensorDict, condition: Condition, seed: int) -> TensorDict:
    """Returns the recorded rows, or rows with outliers or dropout of the corners."""
    if condition == "outliers":
        return with_outliers(rows, seed)
    if condition == "dropout":
        rows = rows.clone()
        there = (torch.arange(len(rows)) % EVERY < EVERY - LOST).unsqueeze(-1)
        rows["seen"] &= there
        rows["motion_observed"] &= there
    return rows


def readings(
    folder: Path, name: str, conditions: Sequence[Condition] = ("as it is",), count: int | None = None, seed: int = 0
) -> TensorDict:
    """Returns a filter's inputs in each condition, ``[C, T]``: motion with covariance, turn rates, masks, time steps.

    The camera triggers regularly, and its stamps have a jitter of a millisecond, so that each row has the median step.
    """
    found = drive(folder, name, count)
    rows = torch.stack([in_condition(found.rows, condition, seed) for condition in conditions])
    motion = corner_motions(rows, calibrated(found.camera), CornerNoise(**CORNERS))
    out = rows.select("gyro", "gyro_observed", "motion_observed", "dt", "time", "step")
    out["dt"] = found.rows["dt"].median().expand(out["dt"].shape).clone()
    out["motion"], out["motion_cov"] = motion.motion, motion.cov
    hidden = ~out["motion_observed"].squeeze(-1)
    out["motion"][hidden] = SE3().neutral(out["motion"])
    out["motion_cov"][hidden] = torch.eye(6, dtype=torch.float64)
    return out


def naive(folder: Path, name: str, condition: Condition, count: int | None = None, seed: int = 0):
    """Returns OpenCV's refined motions ``[T, 7]`` from corners with KITTI's calibration, and their observed mask."""
    found = drive(folder, name, count)
    rows, camera = in_condition(found.rows, condition, seed), found.camera
    matrix = np.array([[camera.focal, 0, camera.center[0]], [0, camera.focal, camera.center[1]], [0, 0, 1.0]])
    before, after = (camera.corners(rows["corners"][:, :, row]) for row in (0, 1))
    motions = SE3().neutral(before).repeat(len(rows), 1)
    seen = rows["motion_observed"].squeeze(-1).clone()
    for row in torch.nonzero(seen).flatten().tolist():
        use = rows["seen"][row] & (before[row, :, 2] > 1)
        points, places = camera.points(before[row, use]).numpy(), after[row, use, :2].contiguous().numpy()
        cv2.setRNGSeed(0)
        good, turn, move, kept = cv2.solvePnPRansac(points, places, matrix, None, reprojectionError=1.5)
        if not good or kept is None or len(kept) < 6:
            seen[row] = False
            continue
        kept = kept[:, 0]
        turn, move = cv2.solvePnPRefineLM(points[kept], places[kept], matrix, None, turn, move)
        to_later = torch.as_tensor(cv2.Rodrigues(turn)[0])
        motions[row] = torch.cat([quaternion_of(to_later.mT), -(to_later.mT @ torch.as_tensor(move)).squeeze(-1)])
    return motions, seen


def chained(motions: Tensor, seen: Tensor, dt: Tensor) -> Tensor:
    """Returns a path ``[T, 7]`` of chained motions ``[T, 7]``, with zero-order hold for missing motions."""
    path, twist = [SE3().neutral(motions)], motions.new_zeros(6)
    twists = SE3().log(motions) / dt
    for row in range(1, len(motions)):
        twist = twists[row] if seen[row] else twist
        path.append(SE3().plus(path[-1], twist * dt[row]))
    return torch.stack(path)
