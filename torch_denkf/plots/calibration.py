"""Histograms that are flat for a calibrated belief."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.metrics import pit
from torch_denkf.plots._axes import FILL, TRUTH, axes_for, label_below, labels_for, legend_above
from torch_denkf.plots._belief import TensorOrKey, dims_of, read_belief, with_truth
from torch_denkf.plots._space import in_tangents, names_of
from torch_denkf.plots.histograms import histogram_band, rank_histogram

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_calibration"]


def plot_calibration(
    run: TensorDictBase,
    truth: TensorOrKey = None,
    *,
    belief: NestedKey = "belief",
    dims: Sequence[int] | None = None,
    names: Sequence[str] | None = None,
    kind: Literal["auto", "pit", "rank"] = "auto",
    bins: int = 10,
    every: int = 1,
    level: float = 0.99,
    space: Space | None = None,
    legend: bool = True,
    ax: Axes | Sequence[Axes] | None = None,
) -> list[Axes]:
    """Draws a histogram of the truth within the belief: flat if calibrated, high at both ends if overconfident.

    A Gaussian belief gives the probability integral transform, an ensemble the rank of the truth among its members.
    The bars of a calibrated filter all end in the grey band with probability ``level``, if the states are independent.

    Args:
        run: roll-outs or sequences ``[*B]``, time last, with ``("belief", "mean")`` ``[*B, S]`` and
            ``("belief", "var")``, or ``("belief", "ensemble")`` ``[*B, E, S]``.
        truth: ``[*B, S']``, or its key; by default ``"state"`` of the roll-out.
        belief: key of the belief, such as a smoother's ``"smoothed"``.
        dims: components to draw, an Axes each; all by default.
        names: label of each component.
        kind: ``"rank"`` or ``"pit"``; ``"auto"`` takes ranks if there is an ensemble. Particles count with their
            weights, ``("belief", "log_weight")`` ``[*B, E]``; if a few have nearly all the weight, the outer bars are a
            little higher.
        bins: number of bins, among which an ensemble's E+1 ranks are divided equally.
        every: use every n-th step of time. Errors of successive steps are correlated, which moves bars out of the band.
        level: probability of the band, for all bars of an Axes together.
        space: space of the states; ``None`` for vectors. Components are then those of the tangent from the mean to the
            truth: a rotation has three, about the body's axes.
        legend: whether to add a legend above the first Axes.
        ax: as many Axes as components; ``None`` makes a figure.

    Returns:
        The Axes, one per component, with bars in per cent of the states; the band has the gid ``"band"``.

    Raises:
        ImportError: without matplotlib; the message names the extra.
        KeyError: if the roll-out has no belief, or lacks the given truth.
        ValueError: without a truth, for shapes that do not match, for a kind that the belief does not allow, and for
            more bins than an ensemble has ranks.
        IndexError: if ``dims`` names no dimension.

    Example:
        >>> from tensordict import TensorDict
        >>> draws = torch.randn(1000, 10, 1, generator=torch.Generator().manual_seed(0))
        >>> (axes,) = plot_calibration(TensorDict({"ensemble": draws[:, 1:]}, [1000]), draws[:, 0], names=["x"])
        >>> [round(float(bar.get_height()), 1) for bar in axes.containers[0]]
        [10.2, 10.2, 10.8, 9.7, 10.2, 10.2, 11.4, 9.2, 8.8, 9.3]
    """
    space = check_space("space", space)
    read = read_belief(run, truth, belief=belief, space=space)
    if space is not None:
        read = in_tangents(read, space)
    chosen = dims_of(read, dims)
    if names is None and space is not None:
        names = [names_of(space, ("about x", "about y", "about z"))[dim] for dim in chosen]
    if every < 1 or bins < 2:
        raise ValueError(f"every must be at least 1 and bins at least 2; got {every} and {bins}")
    ranks = kind == "rank" or (kind == "auto" and read.ensemble is not None)
    if kind not in ("auto", "pit", "rank"):
        raise ValueError(f'kind must be "auto", "pit" or "rank"; got {kind!r}')
    if ranks and read.ensemble is None:
        raise ValueError('kind="rank" needs ("belief", "ensemble"); pass kind="pit"')
    rows = torch.zeros_like(read.known)
    rows[..., ::every] = read.known[..., ::every]
    true = with_truth(read, chosen)[rows]
    if ranks:
        assert read.ensemble is not None
        weight = None if read.log_weight is None else read.log_weight[rows]
        counts = _rebin(rank_histogram(read.ensemble[rows][..., chosen], true, log_weight=weight), bins)
    elif read.var is None:
        raise ValueError('the spread is missing: the belief needs "var", "cov" or "ensemble"')
    else:
        if bool(true.isnan().any()):
            raise ValueError("the truth is NaN in places, where it is not known; leave out the rows that are not whole")
        values = pit(read.mean[rows][:, chosen], read.var[rows][:, chosen], true)
        counts = torch.stack([torch.histc(column, bins, 0, 1) for column in values.unbind(-1)])
    samples = len(true)
    low, high = (100 * count / samples for count in histogram_band(samples, bins, level=level))
    panels = axes_for(ax, len(chosen), (8, 1.2 + 2.4 * len(chosen)), share=True)
    for axes, label, heights in zip(panels, labels_for(names, chosen), counts, strict=True):
        shares, what = 100 * heights.numpy() / samples, "ranks" if ranks else "PIT values"
        axes.bar(np.arange(bins) / bins, shares, 1 / bins, align="edge", color=FILL, edgecolor="white", label=what)
        axes.axhline(100 / bins, color=TRUTH, linewidth=1, linestyle=":", label="uniform")
        band = f"calibrated bars end here ({100 * level:g} %)"
        axes.axhspan(low, high, facecolor=(0, 0, 0, 0.12), edgecolor="0.3", linewidth=1, label=band, gid="band")
        axes.set(ylabel=f"{label}\nshare of steps, %", xlim=(0, 1), ylim=(0, 1.1 * max(shares.max(), high)))
    label_below(panels, "rank of the truth, 0 to 1" if ranks else "probability below the truth")
    if legend:
        legend_above(*panels)
    return panels


def _rebin(counts: Tensor, bins: int) -> Tensor:
    """Divides E+1 ranks equally among bins, ``[S, bins]``; a rank at a boundary is split between two bins."""
    ranks = counts.shape[-1]
    if bins > ranks:
        raise ValueError(f"{ranks - 1} members have {ranks} ranks, too few for {bins} bins")
    edges = torch.arange(bins + 1, dtype=torch.float64) * ranks / bins
    total = torch.cat([torch.zeros_like(counts[:, :1]), counts.cumsum(-1)], -1)
    whole = edges.floor().long().clamp(max=ranks - 1)
    below = total[:, whole] + (edges - whole) * counts[:, whole]
    return below.diff(dim=-1)
