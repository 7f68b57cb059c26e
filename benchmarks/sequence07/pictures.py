"""Draws the path from above, the error over the length of a segment, and the coverage of intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.common.plots import plt, save
from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error

__all__ = ["draw"]

CONDITION = "recorded"
LENGTHS = (100, 200, 300, 400, 500, 600)  # m; the drive has 695
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)


def draw(paths: Mapping, claims: Mapping, poses: Tensor, steps: Sequence[int], file: Path) -> None:
    """Draws the drive as recorded.

    Args:
        paths: by condition and filter, ``[T, 7]``.
        claims: relative motions with variances, by condition and filter.
        poses: true ones, ``[T, 7]``.
        steps: rows of the relative motions.
        file: PNG.
    """
    named = {"OpenCV, RANSAC": "C3", "EKF": "C0", "DEnKF, 64 members": "C1", "RTS smoother": "C2"}
    figure, (above, along, claimed) = plt.subplots(1, 3, figsize=(13, 4.3), layout="constrained")
    above.plot(poses[:, 4], poses[:, 6], "k", lw=2.5, label="truth")
    for name, color in named.items():
        path = paths.get((CONDITION, name))
        if path is None:
            continue
        above.plot(path[:, 4], path[:, 6], color, lw=1, label=name)
        error = kitti_devkit_error(path, poses, lengths=LENGTHS).length_translation
        along.plot(LENGTHS, error, f"{color}o-", ms=4, label=name)
    above.set(xlabel="to the right, m", ylabel="ahead, m", aspect="equal", title="from above")
    along.set(xlabel="length of a segment, m", ylabel="error, %", ylim=(0, None), title="translation")
    for name, marker in (("EKF", "o"), ("DEnKF, 64 members", "x")):
        claim = claims.get((CONDITION, name))
        if claim is not None:
            held = torch.stack([claim.held(level) for level in LEVELS])
            for at, step in enumerate(steps):
                claimed.plot(LEVELS, held[:, at], f"C{at}{marker}-", lw=1, ms=4, label=f"{name}, {step} rows")
    claimed.plot([0, 1], [0, 1], "k--", lw=1)
    claimed.set(xlabel="nominal", ylabel="coverage", title="relative motion: intervals")
    for axis in (above, along, claimed):
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    save(figure, file)
