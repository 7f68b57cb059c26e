"""Plots the error over the predicted spread."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import TYPE_CHECKING

from tensordict import NestedKey, TensorDictBase

from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.plots._axes import BELIEF, MARKERS, OTHERS, TRUTH, axes_for, labels_for, legend_above, one_each
from torch_denkf.plots._belief import TensorOrKey, dims_of, read_belief, with_truth
from torch_denkf.plots._space import angles_of, in_tangents, names_of
from torch_denkf.plots.histograms import spread_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_spread_error"]


def plot_spread_error(
    run: TensorDictBase,
    truth: TensorOrKey = None,
    *,
    belief: NestedKey = "belief",
    dims: Sequence[int] | None = None,
    names: Sequence[str] | None = None,
    factors: Sequence[float] | None = None,
    bins: int = 8,
    space: Space | None = None,
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draws the root mean square error of the mean over the predicted spread, in bins of similar spread.

    On the diagonal the filter is calibrated; above it, overconfident.

    Args:
        run: roll-outs or sequences ``[*B]`` with ``("belief", "mean")`` ``[*B, S]`` and ``("belief", "var")`` or
            ``("belief", "ensemble")`` ``[*B, E, S]``. The spread of E members is scaled with sqrt((E+1)/E).
        truth: ``[*B, S']``, or its key; by default ``"state"`` of the roll-out.
        belief: key of the belief, such as a smoother's ``"smoothed"``.
        dims: components to draw, a line each; all by default. They should have a similar size.
        names: label with unit of each component, such as ``"v, m/s"``.
        factors: factor on each component, such as ``180 / pi`` for degrees.
        bins: number of points of a line, each for equally many states.
        space: space of the states; ``None`` for vectors. Components are then those of the tangent from the mean to the
            truth: a rotation has three, about the body's axes, in degrees.
        legend: whether to add a legend above the Axes.
        ax: Axes to draw into; ``None`` makes a figure.

    Returns: The Axes: a line for each component, then the diagonal.

    Raises:
        ImportError: without matplotlib; the message names the extra.
        KeyError: if the roll-out has no belief, or lacks the given truth.
        ValueError: without a truth or a variance, for shapes that do not match, and for fewer states than bins.
        IndexError: if ``dims`` names no dimension.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> std = torch.linspace(1, 2, 4000).unsqueeze(-1)
        >>> belief = TensorDict({"mean": 0 * std, "var": std**2}, [4000])
        >>> axes = plot_spread_error(belief, std * torch.randn(4000, 1), names=["x, m"])
        >>> [line.get_label() for line in axes.get_lines()]
        ['x, m', 'spread = error']
    """
    space = check_space("space", space)
    read = read_belief(run, truth, belief=belief, space=space)
    if space is not None:
        read = in_tangents(read, space)
    chosen, turned = dims_of(read, dims), [] if space is None else angles_of(space)
    if names is None and space is not None:
        names = [names_of(space, ("about x, deg", "about y, deg", "about z, deg"))[dim] for dim in chosen]
    if read.var is None:
        raise ValueError('the spread is missing: the belief needs "var", "cov" or "ensemble"')
    points = spread_error(
        read.mean[read.known][:, chosen],
        read.var[read.known][:, chosen],
        with_truth(read, chosen)[read.known],
        bins=bins,
        ensemble_size=read.ensemble_size,
    )
    (axes,) = axes_for(ax, 1, (6.4, 6.8))
    usual = [180 / pi if dim in turned else 1.0 for dim in chosen]
    labels, scales = labels_for(names, chosen), one_each("factors", factors, usual)
    highest = 0.0
    for column, (label, scale) in enumerate(zip(labels, scales, strict=True)):
        spread, error = scale * points.spread[column].numpy(), scale * points.error[column].numpy()
        colour = (BELIEF, *OTHERS)[column % 6]
        axes.plot(spread, error, "-", marker=MARKERS[column % len(MARKERS)], color=colour, label=label)
        highest = max(highest, spread.max(), error.max())
    limits = (0.0, highest * 1.05)
    axes.plot(limits, limits, ":", color=TRUTH, label="spread = error")
    units = dict.fromkeys(label.rpartition(", ")[2] for label in labels if ", " in label)
    unit = f", {' or '.join(units)}" if units else ""
    axes.set(xlabel=f"predicted spread{unit}", ylabel=f"RMS error{unit}", xlim=limits, ylim=limits)
    axes.set_aspect("equal", adjustable="box")
    if legend:
        legend_above(axes)
    return axes
