"""Plots the path of the belief and the true path."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.plots._axes import BELIEF, DASHES, OTHERS, READING, TRUTH, axes_for, legend_above, new_figure
from torch_denkf.plots._belief import Belief, TensorOrKey, covariance_at, dims_of, number, read_belief, with_truth

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_path"]

MEMBERS, ELLIPSES = 32, 12  # number of drawn members (the first ones) and ellipses (evenly over time)


def plot_path(
    run: TensorDictBase | Tensor,
    truth: TensorOrKey = None,
    *,
    belief: NestedKey = "belief",
    others: Mapping[str, Tensor] | None = None,
    readings: Tensor | None = None,
    dims: Sequence[int] = (0, 1),
    forward_up: bool = False,
    spread: Literal["auto", "ensemble", "ellipses", "none"] = "auto",
    level: float = 0.9,
    unit: str = "m",
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draws the mean path with its spread, the true path and others, with equal scales of both axes.

    Args:
        run: a roll-out or sequence of T steps with ``("belief", "mean")`` ``[T, S]`` or ``("belief", "ensemble")``
            ``[T, E, S]``; or means ``[T, S]``.
        truth: ``[T, S']``, or its key; by default ``"state"`` of the roll-out if it exists.
        belief: key of the belief, such as a smoother's ``"smoothed"``.
        others: further paths by name, states ``[T', S']`` such as dead reckoning.
        readings: readings of the drawn dimensions ``[T', 2]``, in the state's units, drawn as dots; set missing ones to
            NaN, as rows that are not finite are left out.
        dims: dimensions of the state for the horizontal and the vertical axis; three give a 3-D plot.
        forward_up: draw a car's (x forward, y left) as a map that it drives up: ``-y`` to the right, ``x`` upwards.
        spread: ``"ensemble"`` draws the members' paths, ``"ellipses"`` draws ``level`` of a Gaussian at some steps;
            ``"auto"`` takes members with equal weights, else ellipses if there is a covariance or a variance. Particles
            have no continuous paths, as resampling reorders them.
        level: probability of an ellipse.
        unit: unit of the coordinates.
        legend: whether to add a legend above the Axes.
        ax: Axes to draw into; 3-D for three dims. ``None`` makes a figure.

    Returns:
        The Axes. Lines have labels; the ellipse of step t has the gid ``"step t"``.

    Raises:
        ImportError: without matplotlib; the message names the extra.
        KeyError: if the roll-out has no belief, or lacks the given truth.
        ValueError: for more than one sequence, shapes that do not match, and a spread that the belief does not have.
        IndexError: if ``dims`` names no dimension.

    Example:
        >>> t = torch.linspace(0, 6, 50)
        >>> truth = torch.stack([t.cos(), t.sin()], -1)
        >>> axes = plot_path(truth + 0.02 * torch.randn(50, 2), truth)
        >>> [line.get_label() for line in axes.get_lines()]
        ['truth', 'belief']
    """
    read = read_belief(run, truth, belief=belief, one_sequence=True)
    chosen = dims_of(read, dims)
    if len(chosen) not in (2, 3) or (forward_up and len(chosen) == 3):
        raise ValueError(f"dims must name two dimensions, or three in space without forward_up; got {list(dims)}")
    kind = _kind(read, spread, len(chosen))
    axes = _axes(ax, len(chosen))

    def place(states: Tensor, dims: Sequence[int] = chosen) -> list[np.ndarray]:
        """Returns coordinates on the picture's axes, each ``[T, ...]``."""
        parts = [states[..., dim].numpy() for dim in dims]
        return [-parts[1], parts[0]] if forward_up else parts

    if kind == "ensemble":
        assert read.ensemble is not None
        for index, member in enumerate(read.ensemble[:, :MEMBERS].unbind(1)):
            label = "members" if index == 0 else None
            axes.plot(*place(member), color=BELIEF, alpha=0.15, linewidth=0.8, label=label, zorder=1.5)
    if read.truth is not None:
        with_truth(read, chosen)
        axes.plot(*place(read.truth), color=TRUTH, linewidth=1.8, label="truth", zorder=2.1)
    for index, (name, path) in enumerate((others or {}).items()):
        style: dict[str, Any] = {"color": OTHERS[index % len(OTHERS)], "linestyle": DASHES[index % len(DASHES)]}
        axes.plot(*place(number(path)), linewidth=1.4, label=name, zorder=2.2, **style)
    if readings is not None:
        dots = number(readings)
        if dots.ndim != 2 or dots.shape[-1] != len(chosen):
            raise ValueError(f"readings must be [T, {len(chosen)}], a column for each of dims; got {list(dots.shape)}")
        shown = place(dots[dots.isfinite().all(-1)], range(len(chosen)))
        axes.plot(*shown, ".", color=READING, markersize=3.5, label="readings", zorder=2.25)
    axes.plot(*place(read.mean), color=BELIEF, linewidth=1.4, label=read.name, gid="belief", zorder=2.3)
    if kind == "ellipses":
        _draw_ellipses(axes, read, chosen, forward_up, level)
    names = ["right", "forward"] if forward_up else [_name(dim) for dim in chosen]
    axes.set(xlabel=f"{names[0]}, {unit}", ylabel=f"{names[1]}, {unit}")
    if len(chosen) == 3:
        axes.set_zlabel(f"{names[2]}, {unit}")  # type: ignore[attr-defined]
        _cube(axes)
    else:
        axes.set_aspect("equal", adjustable="datalim")
    if legend:
        legend_above(axes)
    return axes


def _kind(read: Belief, spread: str, count: int) -> str:
    """Returns the kind of spread to draw."""
    if spread not in ("auto", "ensemble", "ellipses", "none"):
        raise ValueError(f'spread must be "auto", "ensemble", "ellipses" or "none"; got {spread!r}')
    if spread == "ensemble" and read.ensemble_size is None:
        raise ValueError('spread="ensemble" needs ("belief", "ensemble") of equal weights; pass spread="ellipses"')
    if spread == "ellipses" and (count == 3 or read.var is None):
        raise ValueError('spread="ellipses" needs two dims and a variance or a covariance of the belief')
    if spread == "auto":
        if read.ensemble_size is not None:
            return "ensemble"
        return "none" if count == 3 or read.var is None else "ellipses"
    return spread


def _axes(ax: Axes | None, count: int) -> Axes:
    if ax is None and count == 3:
        return new_figure((8, 6)).add_subplot(projection="3d")
    (axes,) = axes_for(ax, 1, (8, 6))
    if hasattr(axes, "set_zlabel") != (count == 3):
        raise ValueError(f"{count} dims do not fit the Axes; three need projection='3d', two must not")
    return axes


def _name(dim: int) -> str:
    return "xyz"[dim] if dim < 3 else f"state {dim}"


def _draw_ellipses(axes: Axes, read: Belief, dims: list[int], forward_up: bool, level: float) -> None:
    """Draws the ellipses of probability ``level``: half axes are sqrt(-2 ln(1 - level)) standard deviations."""
    from matplotlib.patches import Ellipse

    if not 0 < level < 1:
        raise ValueError(f"level is the probability of an ellipse, in (0, 1); got {level}")
    # (x, y) to (-y, x)
    turn = torch.tensor([[0.0, -1.0], [1.0, 0.0]] if forward_up else [[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    mean = read.mean[:, dims] @ turn.T
    reach = math.sqrt(-2 * math.log1p(-level))
    steps = read.known.nonzero().flatten().numpy()
    evenly = np.unique(np.linspace(0, len(steps) - 1, ELLIPSES).round().astype(int))
    for first, step in enumerate(steps[evenly].tolist()):
        squares, directions = np.linalg.eigh((turn @ covariance_at(read, step, dims) @ turn.T).numpy())
        small, large = 2 * reach * np.sqrt(squares.clip(0))
        angle = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
        style: dict[str, Any] = {"facecolor": BELIEF, "edgecolor": BELIEF, "alpha": 0.3, "zorder": 1.5}
        centre = (float(mean[step, 0]), float(mean[step, 1]))
        patch = Ellipse(centre, large, small, angle=angle, gid=f"step {step}", **style)
        patch.set_label(None if first else f"{100 * level:g} % of the {read.name}")
        axes.add_patch(patch)


def _cube(axes: Any) -> None:
    """Gives the three axes the same span, for equal scales."""
    from matplotlib.ticker import MaxNLocator

    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    middle, half = limits.mean(1), float(np.ptp(limits, axis=1).max()) / 2
    for centre, set_limits in zip(middle, (axes.set_xlim, axes.set_ylim, axes.set_zlim), strict=True):
        set_limits(centre - half, centre + half)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    axes.set_box_aspect((1, 1, 1), zoom=0.9)
