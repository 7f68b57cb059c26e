r"""Odometry errors on KITTI: end-point error per metre travelled.

Poses are ``(x, y, θ)``: metres forward, metres left, radians to the left. The metric is that of Jonschkowski & Brock
2018 (differentiable particle filters), Haarnoja et al. 2016 (backprop KF) and Kloss et al. 2021 (how to train your
differentiable filter): for every window of N steps the distance between both end points and the difference of both
final headings, each divided by the length of the true path, averaged over windows. A path in the wrong direction at the
right speed therefore has a large error, unlike with the path-length error of the DEnKF paper's reference script.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.applications.car.metrics._paths import check_paths, relative_pose_error, step_lengths
from torch_denkf.functional import wrap_angles

__all__ = ["EndpointError", "dead_reckoning", "kitti_endpoint_error"]


class EndpointError(NamedTuple):
    """Result of :func:`kitti_endpoint_error`; ``*B`` are the batch dims of the paths, W the number of windows.

    Attributes:
        translation: mean end point error over the valid windows, in m/m, ``[*B]``.
        rotation: mean error of the final heading over the same windows, in deg/m, ``[*B]``.
        window_translation: error of each window, in m/m, ``[*B, W]``; NaN in windows left out.
        window_rotation: error of each window, in deg/m, ``[*B, W]``; NaN in windows left out.
        windows: number of valid windows, ``[*B]``, int64.
    """

    translation: Tensor
    rotation: Tensor
    window_translation: Tensor
    window_rotation: Tensor
    windows: Tensor


def kitti_endpoint_error(
    estimated: Tensor,
    truth: Tensor,
    *,
    window: int = 100,
    stride: int = 1,
    align: bool = True,
    min_length: float = 1.0,
) -> EndpointError:
    """Returns the end point error of every window of ``window`` steps, per metre of the true path.

    Window i compares rows i and i + ``window``, so a path of T rows has ``(T - window - 1) // stride + 1`` windows.
    Windows whose true path is shorter than ``min_length`` are left out, because an error per metre is meaningless for a
    standing car.

    Args:
        estimated: poses (x m, y m, θ rad), ``[*B, T, 3]``.
        truth: the true poses, of the same shape.
        window: N, in steps (not metres); the literature reports 100, 200, 400 and 800.
        stride: steps between the starts of two windows.
        align: align the first estimated pose of each window with the true one, by a translation and a rotation, so that
            only errors within the window count. Otherwise the poses are compared without alignment.
        min_length: shortest true path of a valid window, in m.

    Returns:
        An :class:`EndpointError`.

    Raises:
        ValueError: if the shapes are not ``[*B, T, 3]`` or differ, if the path is shorter than a window, if ``window``
            or ``stride`` is not positive, or if a path has no window of ``min_length``.

    Source:
        Jonschkowski, Rastogi & Brock 2018, arXiv:1805.11122, section V-B; Kloss, Martius & Bohg 2021,
        arXiv:2012.14313, section 6.

    Examples:
        A car on a straight line whose speed is overestimated by a tenth.

        >>> x = torch.arange(201.0)
        >>> truth = torch.stack([x, 0 * x, 0 * x], -1)
        >>> error = kitti_endpoint_error(truth * 1.1, truth)
        >>> round(error.translation.item(), 6), error.rotation.item(), error.windows.item()
        (0.1, 0.0, 101)
    """
    check_paths(estimated, truth)
    if window < 1 or stride < 1:
        raise ValueError(f"window and stride count steps and must be at least 1, got {window} and {stride}")
    steps = truth.shape[-2] - 1
    if steps < window:
        raise ValueError(
            f"a window of {window} steps needs {window + 1} poses, got {steps + 1}; pass a longer path or "
            "a smaller window"
        )
    first = torch.arange(0, steps - window + 1, stride, device=truth.device)
    last = first + window
    if align:
        distance, angle = relative_pose_error(
            estimated[..., first, :], estimated[..., last, :], truth[..., first, :], truth[..., last, :]
        )
    else:
        difference = estimated[..., last, :] - truth[..., last, :]
        distance, angle = torch.linalg.vector_norm(difference[..., :2], dim=-1), wrap_angles(difference[..., 2]).abs()
    length = step_lengths(truth).unfold(-1, window, stride).sum(-1)
    counts = length >= min_length
    windows = counts.sum(-1)
    if bool((windows == 0).any()):
        raise ValueError(
            f"a path has no window of {window} steps in which the car travels {min_length} m; "
            "leave such paths out, or pass a larger window or a smaller min_length"
        )
    length = torch.where(counts, length, torch.nan)
    translation, rotation = distance / length, torch.rad2deg(angle) / length
    return EndpointError(translation.nanmean(-1), rotation.nanmean(-1), translation, rotation, windows)


def dead_reckoning(velocities: Tensor, initial: Tensor, dt: float | Tensor) -> Tensor:
    """Integrates speed and turn rate to a path (dead reckoning, without a filter).

    Step t moves along the mean heading of rows t-1 and t, ``θ_{t-1} + θ_dot_t dt / 2``, which is exact for the chord of
    a circular arc. Differentiable in all arguments.

    Args:
        velocities: (v m/s, θ_dot rad/s), ``[*B, T, 2]``; row t is the motion from t-1 to t, so that row 0 is not used.
        initial: the pose (x m, y m, θ rad) at row 0, ``[*B, 3]``.
        dt: time between rows in s.

    Returns:
        Poses (x m, y m, θ rad), ``[*B, T, 3]``; row 0 is ``initial``, and θ is not wrapped. Pass float64 for thousands
        of rows.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> dead_reckoning(torch.tensor([[9.0, 9.0], [10.0, 0.0], [10.0, 0.0]]), torch.zeros(3), 0.1)
        tensor([[0., 0., 0.],
                [1., 0., 0.],
                [2., 0., 0.]])
    """
    if velocities.ndim < 2 or velocities.shape[-1] != 2 or velocities.shape[-2] < 1:
        raise ValueError(
            f"velocities must be [*B, T, 2] = (v, theta_dot), got {list(velocities.shape)}; of a state, pass "
            "state[..., 3:]"
        )
    if initial.shape != (*velocities.shape[:-2], 3):
        raise ValueError(
            f"initial must be [*B, 3] = {[*velocities.shape[:-2], 3]}, got {list(initial.shape)}; "
            "of a state, pass state[..., 0, :3]"
        )
    steps = velocities[..., 1:, :] * dt
    turned = steps[..., 1].cumsum(-1)
    heading = initial[..., None, 2] + turned - steps[..., 1] / 2
    x = initial[..., None, 0] + (steps[..., 0] * heading.cos()).cumsum(-1)
    y = initial[..., None, 1] + (steps[..., 0] * heading.sin()).cumsum(-1)
    path = torch.stack([x, y, initial[..., None, 2] + turned], -1)
    return torch.cat([initial.unsqueeze(-2), path], -2)
