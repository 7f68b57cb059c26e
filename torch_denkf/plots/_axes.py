"""Axes, colours for colour-blind readers, and legends that cover no data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe & Ito 2008, "Color universal design".
BELIEF, FILL, READING, TRUTH, UNSEEN = "#0072B2", "#9CCBEA", "#D55E00", "black", "0.85"
OTHERS = ("#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#0072B2")
DASHES = ("--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


T = TypeVar("T")


def new_figure(size: tuple[float, float]) -> Figure:
    """Returns a new figure that is not registered with pyplot, width and height in inches.

    Raises:
        ImportError: without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('pictures need matplotlib: pip install "torch_denkf[plots]"') from error
    return Figure(figsize=size, layout="constrained")


def axes_for(
    ax: Axes | Sequence[Axes] | None, count: int, size: tuple[float, float], *, share: bool = False
) -> list[Axes]:
    """Returns the given Axes, or ``count`` new ones in a column.

    Args:
        ax: an Axes, ``count`` of them, or ``None``.
        count: number of Axes.
        size: width and height of a new figure in inches.
        share: whether new Axes share their horizontal axis.

    Raises:
        ImportError: without matplotlib.
        ValueError: if another number of Axes was passed.
    """
    if ax is None:
        figure = new_figure(size)
        return list(figure.subplots(count, 1, sharex=share, squeeze=False).flat)
    given = list(np.ravel(np.asarray(ax, dtype=object)))
    if len(given) != count:
        raise ValueError(f"{count} Axes are needed, one a component; got {len(given)}")
    return given


def legend_above(axes: Axes, *others: Axes) -> None:
    """Adds a legend above the Axes for all labels in it and in the others, in as many columns as fit.

    For a title use ``axes.figure.suptitle``.
    """
    found: dict[str, Any] = {}
    for part in (axes, *others):
        for handle, label in zip(*part.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    labels, handles = list(found), list(found.values())
    if not handles:
        return
    pixels, whole = axes.get_window_extent().width, axes.figure.bbox.width
    pixels *= 1.1 if pixels > 0.7 * whole else 1.0  # the layout will widen a single Axes
    width = 72 * pixels / axes.figure.dpi  # points
    sizes = [4.8 * len(label) + 43 for label in labels]
    columns = len(labels)
    while columns > 1:
        rows = -(-len(labels) // columns)  # filled column by column
        if sum(max(sizes[first : first + rows]) for first in range(0, len(sizes), rows)) <= width:
            break
        columns -= 1
    legend = axes.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0, 1.01),
        borderaxespad=0,
        ncols=columns,
        fontsize=9,
        frameon=False,
    )
    for handle in legend.get_lines():  # makes faint lines visible in the legend
        handle.set_alpha(max(handle.get_alpha() or 1.0, 0.6))


def label_below(panels: Sequence[Axes], label: str) -> None:
    """Labels the horizontal axis of the lowest Axes: the last one of a column, or all of a row."""
    bottoms = [axes.get_position().y0 for axes in panels]
    for axes, bottom in zip(panels, bottoms, strict=True):
        if bottom < min(bottoms) + 1e-6:
            axes.set_xlabel(label)


def one_each(what: str, given: Sequence[T] | None, default: list[T]) -> list[T]:
    """Returns one value per drawn component.

    Raises:
        ValueError: if there are more or fewer.
    """
    if given is not None and len(given) != len(default):
        raise ValueError(f"{what} needs one entry a drawn component, {len(default)}; got {len(given)}")
    return default if given is None else list(given)


def labels_for(names: Sequence[str] | None, dims: Sequence[int]) -> list[str]:
    """Returns one label per component: the names, or ``state 3`` for dimension 3."""
    return one_each("names", names, [f"state {dim}" for dim in dims])


def times_of(time: float | Tensor | None, steps: int) -> np.ndarray:
    """Returns the times of the steps ``[T]``: given times, multiples of a time step, or step numbers.

    Raises:
        ValueError: for a wrong number of times, and for times that decrease or are all equal.
    """
    if isinstance(time, Tensor):
        seconds = time.detach().cpu().double().flatten().numpy()
    else:
        seconds = np.arange(steps) * (1.0 if time is None else float(time))
    gaps = np.diff(seconds)  # rows may have equal times
    if len(seconds) != steps or bool((gaps < 0).any()) or (len(gaps) > 0 and not gaps.any()):
        raise ValueError(f"time must be {steps} increasing seconds, one a step, or the seconds between two")
    return seconds


def step_bounds(seconds: np.ndarray) -> np.ndarray:
    """Returns the boundaries of steps, half way between their times, ``[T+1]``."""
    if len(seconds) == 1:
        return np.array([seconds[0] - 0.5, seconds[0] + 0.5])
    middle = (seconds[1:] + seconds[:-1]) / 2
    return np.concatenate([[2 * seconds[0] - middle[0]], middle, [2 * seconds[-1] - middle[-1]]])
