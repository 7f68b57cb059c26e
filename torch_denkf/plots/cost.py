"""What accuracy costs: error against time a step, filter by filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_denkf.metrics import pareto_frontier
from torch_denkf.plots._axes import BELIEF, MARKERS, OTHERS, TRUTH, axes_for, legend_above
from torch_denkf.plots._belief import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

__all__ = ["plot_error_cost"]


def plot_error_cost(
    points: Mapping[str, Tensor | Sequence[float] | Sequence[Sequence[float]]],
    *,
    error: str = "error",
    notes: Mapping[str, Sequence[str]] | None = None,
    log_error: bool = False,
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draws each filter's error over the milliseconds of a step, and the Pareto frontier.

    Rings mark the points that no other beats in both; the staircase through them is the least error for a given time.

    Args:
        points: by filter's name, (ms a step, error) ``[2]``, or ``[N, 2]`` for a line through several settings, such as
            ensemble sizes.
        error: label of the error with its unit, such as ``"RMSE of v, m/s"``.
        notes: by filter's name, a short text beside each of its points, such as ``"E = 8"``.
        log_error: whether the error's axis is logarithmic too.
        legend: whether to add one above the Axes.
        ax: to draw into; ``None`` makes a figure.

    Returns:
        The Axes: a line a filter, the rings with the gid ``"rings"``, the staircase with the gid ``"frontier"``.

    Raises:
        ImportError: without matplotlib; the message names the extra.
        ValueError: without points, for other shapes, for values that are not finite, and for times that are not
            positive.

    Example:
        >>> axes = plot_error_cost({"KF": (0.1, 2.0), "DEnKF": [(0.2, 1.5), (0.4, 1.0)], "PF": (0.5, 1.8)})
        >>> [len(line.get_xdata()) for line in axes.get_lines()[:3]]
        [1, 2, 1]
    """
    tables = {name: number(torch.as_tensor(value, dtype=torch.float64)) for name, value in points.items()}
    tables = {name: table.reshape(-1, 2) if table.shape == (2,) else table for name, table in tables.items()}
    for name, table in tables.items():
        if table.ndim != 2 or table.shape[-1] != 2 or not len(table):
            raise ValueError(f"{name}: points must be (ms a step, error), [2] or [N, 2]; got {list(table.shape)}")
        if not bool(table.isfinite().all()) or bool((table[:, 0] <= 0).any()):
            raise ValueError(f"{name}: times must be positive and all values finite; got {table.tolist()}")
    if not tables:
        raise ValueError("no points: nothing to draw")
    (axes,) = axes_for(ax, 1, (8, 5))
    for index, (name, table) in enumerate(tables.items()):
        colour, marker = (BELIEF, *OTHERS[:-1])[index % 6], MARKERS[index % len(MARKERS)]
        axes.plot(*table.T.numpy(), "-", marker=marker, color=colour, label=name, zorder=2.2)
        for place, note in zip(table.tolist(), (notes or {}).get(name, ()), strict=False):
            # Nothing is at the lower left of a point on the frontier.
            offset: dict[str, Any] = {"xytext": (-4, -8), "textcoords": "offset points", "ha": "right", "va": "top"}
            axes.annotate(note, place, fontsize=8, color="0.2", **offset)
    every = torch.cat(list(tables.values()))
    best = every[pareto_frontier(every)]
    best = best[best[:, 0].argsort()].unique_consecutive(dim=0)
    ring: dict[str, Any] = {"markersize": 13, "markerfacecolor": "none", "markeredgecolor": TRUTH, "gid": "rings"}
    axes.plot(*best.T.numpy(), "o", label="Pareto frontier", zorder=2.3, **ring)
    axes.set_xscale("log")
    _plain_numbers(axes.xaxis)
    if log_error:
        axes.set_yscale("log")
        _plain_numbers(axes.yaxis)
    else:
        axes.set_ylim(0, 1.1 * float(every[:, 1].max()))
    low, high = axes.get_xlim(), axes.get_ylim()
    stairs = torch.cat([best[:1], best, best[-1:]]).numpy()
    stairs[0, 1], stairs[-1, 0] = high[1], low[1]
    axes.plot(*stairs.T, color=TRUTH, linestyle=":", linewidth=1, drawstyle="steps-post", gid="frontier", zorder=1.5)
    axes.set(xlabel="time, ms a step", ylabel=error, xlim=low, ylim=high)
    axes.grid(which="both", alpha=0.2)
    if legend:
        legend_above(axes)
    return axes


def _plain_numbers(axis: Axis) -> None:
    """Writes 0.1, 0.2, 0.5, 1 at a logarithmic axis, as far as there is room."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter("{x:g}")
