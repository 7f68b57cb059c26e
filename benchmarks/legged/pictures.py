"""The velocity of a robot on slippery ground, as two filters believe it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import NormalDist

import torch
from tensordict import TensorDict

from benchmarks.common.plots import plt, save
from benchmarks.legged.task import LEVEL, Robot

__all__ = ["draw"]


def draw(robot: Robot, beliefs: Mapping[str, TensorDict], path: Path, *, seconds: tuple[float, float] = (2, 6)) -> None:
    """Draws three axes of the first run, and below which feet stand.

    Args:
        robot: with its log.
        beliefs: of the filters, by name.
        path: PNG.
        seconds: from when to when.
    """
    half = NormalDist().inv_cdf((1 + LEVEL) / 2)
    rows = slice(*(round(each / robot.dt) for each in seconds))
    time = robot.dt * torch.arange(robot.log.shape[1])[rows]
    true, contact = robot.log["true", "velocity"][0, rows], robot.log["contact"][0, rows]
    options = {"sharex": True, "layout": "constrained", "height_ratios": [3, 3, 3, 1]}
    figure, axes = plt.subplots(4, 1, figsize=(9, 7), **options)
    for number, axis in enumerate(axes[:3]):
        for color, (name, belief) in enumerate(beliefs.items()):
            mean, var = (belief[key][0, rows, number] for key in ("velocity", "velocity_var"))
            axis.fill_between(
                time, mean - half * var.sqrt(), mean + half * var.sqrt(), color=f"C{color}", alpha=0.2, lw=0
            )
            axis.plot(time, mean, f"C{color}", label=f"EKF, {name} contacts, {LEVEL:.0%}")
        axis.plot(time, true[:, number], "k", lw=1, label="truth")
        axis.set_ylabel(f"{'xyz'[number]}, m/s")
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes[3].imshow(contact.T, aspect="auto", extent=(*seconds, 4.5, 0.5), cmap="Greys", interpolation="nearest")
    axes[3].set(ylabel="feet that stand", xlabel="time, s", yticks=[1, 2, 3, 4])
    save(figure, path)
