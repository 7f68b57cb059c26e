"""Roll and pitch of a walk: a filter's intervals, Mahony's filter for comparison."""

from __future__ import annotations

from pathlib import Path
from statistics import NormalDist

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.plots import plt, save

__all__ = ["draw", "roll_and_pitch"]

STRETCH = slice(300, 800)  # rows: five seconds of the walk


def roll_and_pitch(orientation: Tensor) -> Tensor:
    """Returns roll and pitch ``[*, 2]``, rad, of quaternions ``[*, 4]``, with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    w, x, y, z = orientation.unbind(-1)
    roll = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x.square() + y.square()))
    return torch.stack([roll, torch.asin((2 * (w * y - z * x)).clamp(-1, 1))], -1)


def draw(
    data: TensorDict,
    orientation: Tensor,
    cov: Tensor,
    other: Tensor,
    path: Path,
    *,
    name: str,
    level: float = 0.9,
    rows: slice = STRETCH,
) -> None:
    """Draws one run.

    Args:
        data: ``[T]``, with the true ``"orientation"`` and ``"dt"``.
        orientation: of the filter, ``[T, 4]``.
        cov: ``[T, 3, 3]``, of rotations about the body's axes. Roll and pitch are approximated by rotations about x and
            y, which is valid for small angles.
        other: orientations of Mahony's filter, ``[T, 4]``.
        path: PNG.
        name: of the filter.
        level: of the intervals.
        rows: to draw.
    """
    seconds = data["dt"].squeeze(-1).cumsum(0)[rows]
    half = NormalDist().inv_cdf((1 + level) / 2) * cov.diagonal(dim1=-2, dim2=-1)[rows, :2].sqrt().rad2deg()
    truth, mean, beside = (roll_and_pitch(q.float())[rows].rad2deg() for q in (data["orientation"], orientation, other))
    figure, axes = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
    for at, (axis, title) in enumerate(zip(axes, ("roll, degrees", "pitch, degrees"), strict=True)):
        low, high = (mean[:, at] - half[:, at], mean[:, at] + half[:, at])
        axis.fill_between(seconds, low, high, alpha=0.25, lw=0, label=f"{name}, {level:.0%}")
        axis.plot(seconds, mean[:, at], "C0", label=name)
        axis.plot(seconds, beside[:, at], "C1", lw=1, label="Mahony")
        axis.plot(seconds, truth[:, at], "k", lw=1, label="motion capture")
        axis.set_ylabel(title)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes[1].set_xlabel("time, s")
    save(figure, path)
