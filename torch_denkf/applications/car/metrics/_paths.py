"""Geometry of planar paths, for the odometry metrics: poses are (x m, y m, θ rad)."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.angles import wrap_angles


def check_paths(estimated: Tensor, truth: Tensor) -> None:
    """Raises ``ValueError`` unless both are paths ``[*B, T, 3]`` of one shape."""
    if truth.ndim < 2 or truth.shape[-1] != 3 or estimated.shape != truth.shape:
        raise ValueError(
            "estimated and truth must both be [*B, T, 3] = (x, y, theta), got "
            f"{list(estimated.shape)} and {list(truth.shape)}; of a state, pass state[..., :3]"
        )


def step_lengths(path: Tensor) -> Tensor:
    """Returns distances in m between the rows of a path ``[*B, T, 3]``, ``[*B, T-1]``."""
    return torch.linalg.vector_norm(path[..., 1:, :2] - path[..., :-1, :2], dim=-1)


def relative_pose_error(start: Tensor, end: Tensor, true_start: Tensor, true_end: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the relative pose error: difference of the end poses of two motions, aligned at their start.

    Args:
        start: estimated poses (x m, y m, θ rad) at the start of the motions, ``[*B, 3]``.
        end: estimated poses at their end, ``[*B, 3]``.
        true_start: see ``start``.
        true_end: see ``end``.

    Returns:
        The distance of the end points in m and the difference of the headings in [0, π] rad, both ``[*B]``: the
        lengths of the translation and of the rotation of the relative pose error.
    """
    motion, true_motion = end - start, true_end - true_start
    moved = _rotate(motion[..., :2], true_start[..., 2] - start[..., 2])
    distance = torch.linalg.vector_norm(moved - true_motion[..., :2], dim=-1)
    return distance, wrap_angles(motion[..., 2] - true_motion[..., 2]).abs()


def _rotate(vectors: Tensor, angle: Tensor) -> Tensor:
    cos, sin = angle.cos(), angle.sin()
    x, y = vectors.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
