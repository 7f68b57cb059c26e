"""What the pictures of the studies have in common. matplotlib draws without a window."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # after the choice of a back-end without a window
from matplotlib.axes import Axes

from torch_denkf._files import replacing

BAND = 1.645  # standard deviations either side: 90 % of a Gaussian


def draw_band(axis: Axes, seconds, mean, std, truth) -> tuple:
    """Draws truth, mean and 90 % band of one number over time; returns the band's lower and upper edge."""
    low, high = mean - BAND * std, mean + BAND * std
    axis.fill_between(seconds, low, high, color="tab:blue", alpha=0.3, linewidth=0, label="90 % of the belief")
    axis.plot(seconds, truth, "k-", linewidth=1.2, label="truth")
    axis.plot(seconds, mean, color="tab:blue", linewidth=1.2, label="mean of the belief")
    return low, high


def save(figure, path: Path | str, dpi: int = 100) -> None:
    """Writes a figure and closes it."""
    with replacing(path) as beside:
        figure.savefig(beside, dpi=dpi)
    plt.close(figure)
