"""The error of KITTI's odometry leaderboard: drift per metre over segments of 100 to 800 metres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.applications.car.metrics._paths import check_paths, relative_pose_error, step_lengths
from torch_denkf.functional.manifolds import SE3, SO3

__all__ = ["DevkitError", "kitti_devkit_error"]


class DevkitError(NamedTuple):
    """Result of :func:`kitti_devkit_error`; ``*B`` are the batch dims of the paths, L the number of lengths.

    Attributes:
        translation: t_rel, mean over all segments of all lengths, in %, ``[*B]``.
        rotation: r_rel, mean over the same segments, in deg/m, ``[*B]``.
        length_translation: mean over the segments of each length, in %, ``[*B, L]``; NaN if no segment fits.
        length_rotation: mean over the segments of each length, in deg/m, ``[*B, L]``.
        segments: number of segments of each length, ``[*B, L]``, int64.
    """

    translation: Tensor
    rotation: Tensor
    length_translation: Tensor
    length_rotation: Tensor
    segments: Tensor


def kitti_devkit_error(
    estimated: Tensor,
    truth: Tensor,
    *,
    lengths: Sequence[float] = (100, 200, 300, 400, 500, 600, 700, 800),
    step: int = 10,
) -> DevkitError:
    """Returns the relative pose error per metre, over all segments of 100, 200, ..., 800 **metres**.

    As in KITTI's development kit, a segment begins at every tenth frame, and ends with the first frame that lies more
    than its length further along the true path. The estimate is aligned with the truth at the segment's start, and the
    error at its end is divided by the nominal length. The mean is over segments, so long drives and short lengths have
    more weight. For poses in :class:`~torch_denkf.functional.manifolds.SE3` the result is the development kit's. For
    planar poses the error leaves out height, roll and pitch, and is a little smaller than the leaderboard's.

    Args:
        estimated: poses (x m, y m, θ rad), ``[*B, T, 3]``, or (quaternion, position in m), ``[*B, T, 7]``.
        truth: the true poses, of the same shape.
        lengths: lengths of the segments, in m; lengths that do not fit into a path are left out.
        step: frames between the starts of segments.

    Returns:
        A :class:`DevkitError`.

    Raises:
        ValueError: if the shapes are not ``[*B, T, 3]`` or ``[*B, T, 7]``, or differ, if a length or ``step`` is not
            positive, or if no segment of any length fits in a path.

    Source:
        Geiger, Lenz & Urtasun 2012, CVPR; the odometry development kit, ``evaluate_odometry.cpp``.

    Examples:
        A speed error of 10 % on a straight line. A segment ends beyond 100 m, after 101 steps of 1 m: 10.1 %.

        >>> x = torch.arange(151.0)
        >>> truth = torch.stack([x, 0 * x, 0 * x], -1)
        >>> error = kitti_devkit_error(truth * 1.1, truth)
        >>> round(error.translation.item(), 3), error.segments.tolist()
        (10.1, [5, 0, 0, 0, 0, 0, 0, 0])
    """
    spatial = truth.shape[-1] == 7 and estimated.shape == truth.shape
    if not spatial:
        check_paths(estimated, truth)
    if step < 1 or not lengths or min(lengths) <= 0:
        raise ValueError(f"step and lengths must be positive, got step={step} and lengths={list(lengths)}")
    rows = truth.shape[-2]
    # Sums over thousands of steps: float32 would move the ends of segments.
    way = truth[..., 4:].double().diff(dim=-2).norm(dim=-1) if spatial else step_lengths(truth.double())
    travelled = torch.nn.functional.pad(way.cumsum(-1), (1, 0))
    first = torch.arange(0, rows, step, device=truth.device)
    metres = torch.tensor(lengths, dtype=travelled.dtype, device=truth.device)
    target = travelled[..., first, None] + metres  # [*B, F, L]
    last = torch.searchsorted(travelled, target.flatten(-2), right=True).reshape(target.shape)
    fits = last < rows
    segments = fits.sum(-2)
    if bool((segments.sum(-1) == 0).any()):
        shortest = travelled[..., -1].min().item()
        raise ValueError(
            f"a path has no segment of {list(lengths)} m; the shortest path is {shortest:.1f} m long; "
            "leave such paths out, or pass smaller lengths"
        )
    start, start_true = (path[..., first, None, :].expand(*last.shape, truth.shape[-1]) for path in (estimated, truth))
    end, end_true = (_rows(path, last.clamp_max(rows - 1)) for path in (estimated, truth))
    of = _spatial_error if spatial else relative_pose_error
    distance, angle = of(start, end, start_true, end_true)
    nominal = torch.where(fits, metres, torch.nan).to(distance.dtype)
    translation, rotation = 100 * distance / nominal, torch.rad2deg(angle) / nominal
    return DevkitError(
        translation.flatten(-2).nanmean(-1),
        rotation.flatten(-2).nanmean(-1),
        translation.nanmean(-2),
        rotation.nanmean(-2),
        segments,
    )


def _spatial_error(start: Tensor, end: Tensor, start_true: Tensor, end_true: Tensor) -> tuple[Tensor, Tensor]:
    """Returns distance in m and angle in rad between the motions of both paths, from points of SE3 ``[*, 7]``."""
    space = SE3()
    moved, moved_true = (space.compose(space.inverse(a), b) for a, b in ((start, end), (start_true, end_true)))
    left = space.compose(space.inverse(moved), moved_true)
    return left[..., 4:].norm(dim=-1), SO3().log(left[..., :4]).norm(dim=-1)


def _rows(path: Tensor, index: Tensor) -> Tensor:
    """Returns the poses of a path ``[*B, T, N]`` at indices ``[*B, F, L]``."""
    flat = index.flatten(-2).unsqueeze(-1).expand(*index.shape[:-2], -1, path.shape[-1])
    return path.gather(-2, flat).reshape(*index.shape, path.shape[-1])
