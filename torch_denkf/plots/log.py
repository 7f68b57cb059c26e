"""Plots the streams of a log: time steps, and quantities that several streams share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from torch_denkf.plots._axes import OTHERS, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_log"]


def draw_log(
    steps: Mapping[str, np.ndarray], changes: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]
) -> Figure:
    """Draws the time steps of each stream, and quantities that several streams share.

    Args:
        steps: times of the readings by stream, s.
        changes: times and values of each stream, by title.

    Raises:
        ImportError: without matplotlib.
    """
    figure = new_figure((8.0, 2.4 * (1 + len(changes))))
    first, *others = figure.subplots(1 + len(changes), 1, squeeze=False, sharex=True)[:, 0]
    colours = {name: OTHERS[number % len(OTHERS)] for number, name in enumerate(steps)}
    for name, times in steps.items():
        first.semilogy(times[1:], np.diff(times), ".", markersize=2, color=colours[name], label=name)
    first.set_ylabel("step, s")
    for axes, (title, streams) in zip(others, changes.items(), strict=True):
        for name, (times, values) in streams.items():
            axes.plot(times, values, linewidth=0.9, color=colours[name], label=name)
        axes.set_ylabel(title)
        axes.set_ylim(max(axes.get_ylim()[0], -2.0), min(axes.get_ylim()[1], 2.0))
    for axes in (first, *others):
        axes.legend(loc="upper right", fontsize=7, markerscale=4)
    (others or [first])[-1].set_xlabel("time, s")
    return figure
