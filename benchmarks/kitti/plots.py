"""Plots of one drive: path, velocities, errors by length, spread against error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from tensordict import TensorDict

from benchmarks.common.plots import plt, save
from benchmarks.kitti.folds import VELOCITIES
from torch_denkf.plots import plot_bands, plot_path, plot_spread_error

SHOWN = {"dims": VELOCITIES, "names": ["v, m/s", "theta_dot, deg/s"], "factors": [1.0, 180 / math.pi]}


def draw_drive(belief: TensorDict, rows: Sequence[dict], title: str, dt: float, file: Path) -> None:
    """Draws a filter's belief on one drive in one condition.

    Args:
        belief: the filter's sequence ``[N]``.
        rows: the drive's rows of the table in this condition, of all filters.
        title: headline.
        dt: s.
        file: PNG.
    """
    figure, axes = plt.subplot_mosaic("pvv;pww;lss", figsize=(14, 10), width_ratios=[1.2, 1, 1], layout="constrained")
    plot_path(belief, forward_up=True, ax=axes["p"])
    read = belief["sensor", "ensemble"].mean(1) / belief["steps"].clamp_min(1)
    readings = dict(zip(VELOCITIES, read.unbind(-1), strict=True))
    plot_bands(belief, readings=readings, time=dt, band="variance", ax=[axes["v"], axes["w"]], **SHOWN)
    for name in dict.fromkeys(row["filter"] for row in rows):
        own = sorted((row["window"], row["translation_m_per_m"]) for row in rows if row["filter"] == name)
        axes["l"].plot(*zip(*own, strict=True), "o-", label=name.replace("_", " "))
    axes["l"].set(xlabel="steps", ylabel="end point error, m/m", xscale="log", ylim=(0, None))
    windows = sorted({row["window"] for row in rows})
    axes["l"].set_xticks(windows, windows)
    axes["l"].minorticks_off()
    axes["l"].legend()
    plot_spread_error(belief[1:], ax=axes["s"], **SHOWN)
    figure.suptitle(title)
    save(figure, file, dpi=90)
