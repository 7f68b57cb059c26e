"""Errors on KITTI for the first N = 100, 200, 400 and 800 steps, as in the paper's table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.applications.car.metrics._paths import check_paths, step_lengths

__all__ = ["WindowErrors", "kitti_pathlength_error"]


class WindowErrors(NamedTuple):
    """Errors over the first N steps; ``*B`` are the batch dims of the paths, W the number of values of N.

    Attributes:
        translation: mean over the windows' lengths, in m/m, ``[*B]``.
        rotation: mean over the windows' lengths, in deg/m, ``[*B]``.
        window_translation: error for each length, in m/m, ``[*B, W]``.
        window_rotation: error for each length, in deg/m, ``[*B, W]``.
        windows: the lengths N, in steps.
    """

    translation: Tensor
    rotation: Tensor
    window_translation: Tensor
    window_rotation: Tensor
    windows: tuple[int, ...]


def kitti_pathlength_error(
    estimated: Tensor, truth: Tensor, *, windows: Sequence[int] = (100, 200, 400, 800)
) -> WindowErrors:
    """Returns errors of path lengths, as the reference script of the DEnKF paper computes them for its table.

    Over the first N steps of a run: the difference between the lengths of both paths, and the difference between both
    unwrapped headings at step N, each divided by the length of the true path.

    The translation error **ignores** the direction of the path: a path in the wrong direction, or in a circle, at the
    right speed scores 0, and speed errors of opposite sign cancel. The rotation error depends on the last heading only,
    so that errors on the way may cancel; it is not wrapped, so that an error of a full turn scores 360 deg, and wrapped
    angles must be unwrapped first. Also report the mean of
    :func:`~torch_denkf.applications.car.metrics.odometry.kitti_endpoint_error` over the same windows, the metric of the
    other papers.

    Args:
        estimated: poses (x m, y m, θ rad), θ unwrapped, ``[*B, T, 3]``.
        truth: the true poses, of the same shape.
        windows: values of N in steps; those above T - 1 are left out.

    Returns:
        A :class:`WindowErrors`; the mean over N is the table's "all lengths".

    Raises:
        ValueError: if the shapes are not ``[*B, T, 3]`` or differ, if no window fits, or if a car stands still for a
            whole window.

    Source:
        Liu et al. 2023, arXiv:2308.09870, Table II, by the script published with it (``result_analysis.py``).

    Examples:
        The true path is straight; the estimate has the same speed at a right angle.

        >>> x = torch.arange(101.0)
        >>> truth, estimated = torch.zeros(2, 101, 3)
        >>> truth[:, 0], estimated[:, 1] = x, x
        >>> kitti_pathlength_error(estimated, truth).translation
        tensor(0.)
    """
    check_paths(estimated, truth)
    windows = _fitting(windows, truth.shape[-2] - 1)
    last = torch.tensor(windows, device=truth.device)
    length, length_true = (step_lengths(path).cumsum(-1)[..., last - 1] for path in (estimated, truth))
    if bool((length_true == 0).any()):
        raise ValueError(f"a true path stands still over one of its first {list(windows)} steps; leave such paths out")
    translation = (length - length_true).abs() / length_true
    rotation = torch.rad2deg((estimated[..., last, 2] - truth[..., last, 2]).abs()) / length_true
    return WindowErrors(translation.mean(-1), rotation.mean(-1), translation, rotation, windows)


def _fitting(windows: Sequence[int], steps: int) -> tuple[int, ...]:
    if not windows or min(windows) < 1:
        raise ValueError(f"windows are numbers of steps, at least 1 each, got {list(windows)}")
    fitting = tuple(window for window in windows if window <= steps)
    if not fitting:
        raise ValueError(
            f"no window of {list(windows)} steps fits into {steps + 1} poses; pass a longer path or smaller windows"
        )
    return fitting
