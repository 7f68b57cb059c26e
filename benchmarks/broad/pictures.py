"""Heading and inclination errors of one trial: the filter's with its intervals, VQF's for comparison."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from benchmarks.broad.task import Trial
from benchmarks.common.plots import plt, save
from torch_denkf.applications.imu.log import Orientations
from torch_denkf.functional.manifolds import SO3, quaternion_product

__all__ = ["draw"]

_HALF = 1.645  # of a 90 % interval, in standard deviations


def draw(trial: Trial, found: Orientations, other: Tensor | None, path: Path, *, every: int = 20) -> None:
    """Draws one trial.

    Args:
        trial: with the truth.
        found: by the filter.
        other: orientations by VQF, ``[T, 4]``; ``None`` for none.
        path: PNG.
        every: draw one of so many rows.
    """
    rows = slice(None, None, every)
    truth = SO3().normalise(trial.orientation[rows])
    seconds = torch.arange(len(trial.orientation))[rows] / trial.rate
    figure, axes = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
    for name, quaternion, colour in (("VQF", other, "C1"), ("filter", found.quaternion, "C0")):
        if quaternion is None:
            continue
        w, _, _, z = quaternion_product(quaternion[rows].double(), SO3().inverse(truth)).unbind(-1)
        axes[0].plot(seconds, (2 * (z / w).atan()).rad2deg(), colour, lw=1, label=name)
        tilt = 2 * (w.square() + z.square()).sqrt().clamp_max(1).acos()
        axes[1].plot(seconds, tilt.rad2deg(), colour, lw=1, label=name)
    half = _HALF * found.std[rows].rad2deg()
    axes[0].fill_between(seconds, -half[:, 2], half[:, 2], color="C0", alpha=0.2, lw=0, label="90 % of the filter")
    axes[1].fill_between(seconds, 0, 2.146 / _HALF * half[:, :2].mean(-1), color="C0", alpha=0.2, lw=0)
    moving = trial.scored[rows].double()
    for axis, title in zip(axes, ("heading error, degrees", "inclination error, degrees"), strict=True):
        low, high = axis.get_ylim()
        axis.fill_between(seconds, low, high, where=moving < 1, color="0.93", lw=0, zorder=0)
        axis.set_ylim(low, high)
        axis.set_ylabel(title)
    axes[0].legend(loc="upper right", ncols=3)
    axes[0].set_title(f"{trial.name}; grey: not scored (at rest, or no truth)")
    axes[1].set_xlabel("s")
    save(figure, path)
