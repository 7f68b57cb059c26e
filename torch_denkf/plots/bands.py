"""Components of a belief over time, with a credible band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.functional import wrap_angles
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.metrics.calibration import ensemble_interval
from torch_denkf.plots._axes import (
    BELIEF,
    READING,
    TRUTH,
    UNSEEN,
    axes_for,
    label_below,
    labels_for,
    legend_above,
    one_each,
    step_bounds,
    times_of,
)
from torch_denkf.plots._belief import Belief, TensorOrKey, dims_of, number, read_belief, with_truth
from torch_denkf.plots._space import angles_of, in_components, names_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_bands"]


def plot_bands(
    run: TensorDictBase | Tensor,
    truth: TensorOrKey = None,
    *,
    belief: NestedKey = "belief",
    dims: Sequence[int] | None = None,
    names: Sequence[str] | None = None,
    factors: Sequence[float] | None = None,
    readings: Mapping[int, Tensor] | None = None,
    observed: TensorOrKey | Mapping[int, TensorOrKey] = None,
    gap: float | None = None,
    time: float | Tensor | None = None,
    level: float = 0.9,
    band: Literal["auto", "ensemble", "variance"] = "auto",
    space: Space | None = None,
    legend: bool = True,
    ax: Axes | Sequence[Axes] | None = None,
) -> list[Axes]:
    """Draws components over time: the belief's mean and band, the truth, readings, and outages.

    Args:
        run: a roll-out or sequence of T steps with ``("belief", "mean")`` ``[T, S]`` and ``("belief", "var")`` or
            ``("belief", "ensemble")`` ``[T, E, S]``; or means ``[T, S]``, which have no band.
        truth: ``[T, S']``, or its key; by default ``"state"`` of the roll-out if it exists.
        belief: key of the belief, such as a smoother's ``"smoothed"``, which is drawn at the step of each state.
        dims: components to draw, an Axes each; all by default.
        names: label with unit of each component, such as ``"v, m/s"``.
        factors: factor on each component, such as ``180 / pi`` for degrees.
        readings: readings by component, ``[T]`` in the state's units; NaN and unobserved ones are left out.
        observed: ``[T]``, ``[T, 1]`` or ``[T, O]`` bool, or its key; by default ``"observed"`` of the roll-out if it
            exists. Outages are shaded. With several sensors, one for each component: ``{0: "gps_observed", 1:
            encoder_mask}``; components without one are not shaded.
        gap: longest time between two readings that is no outage, in s, or in steps without ``time``. By default one and
            a half times the median, so that for a sensor at 1 Hz in a filter at 100 Hz only lost readings are shaded.
        time: seconds of the steps ``[T]``, or the seconds between two; by default steps are counted.
        level: probability of the band.
        band: ``"ensemble"`` draws quantiles of the members; ``"variance"`` draws those of a Gaussian. ``"auto"`` takes
            the ensemble if its members have equal weights and are enough for ``level``.
        space: space of the states; ``None`` for vectors. Components are then those of tangents, with angles, and roll,
            pitch and yaw of a quaternion, in degrees, wrapped to -180 to 180. ``readings`` of angles are in rad.
        legend: whether to add a legend above the first Axes.
        ax: as many Axes as components; ``None`` makes a figure.

    Returns:
        The Axes, one per component.

    Raises:
        ImportError: without matplotlib; the message names the extra.
        KeyError: if the roll-out has no belief, or lacks a given key.
        ValueError: for more than one sequence, shapes that do not match, and a band that the belief does not have.
        IndexError: if ``dims`` names no dimension.

    Example:
        >>> from tensordict import TensorDict
        >>> mean = torch.zeros(5, 1)
        >>> sequence = TensorDict({"belief": {"mean": mean, "var": mean + 4}, "state": mean + 1}, [5])
        >>> (axes,) = plot_bands(sequence, names=["x, m"], time=0.1)
        >>> [round(float(edge), 2) for edge in axes.collections[0].get_datalim(axes.transData).intervaly]
        [-3.29, 3.29]
    """
    seen = None if isinstance(observed, Mapping) else observed
    space = check_space("space", space)
    read = read_belief(run, truth, seen, belief=belief, one_sequence=True, space=space)
    turned: list[int] = []
    if space is not None:
        read, turned = in_components(read, space), angles_of(space)
    chosen = dims_of(read, dims)
    masks = _masks(run, observed) if isinstance(observed, Mapping) else dict.fromkeys(chosen, _seen(read))
    panels = axes_for(ax, len(chosen), (8, 1.2 + 2 * len(chosen)), share=True)
    if names is None and space is not None:
        names = [names_of(space)[dim] for dim in chosen]
    usual = [180 / np.pi if dim in turned else 1.0 for dim in chosen]
    labels, scales = labels_for(names, chosen), one_each("factors", factors, usual)
    seconds = times_of(time, len(read.mean))
    bounds = step_bounds(seconds)
    angular = [dim in turned for dim in chosen]
    mean, lower, upper = _edges(read, chosen, angular, level, band)
    true = None if read.truth is None else _beside(with_truth(read, chosen), mean, angular)
    for what, given in (("readings", readings or {}), ("observed", masks)):
        stray = sorted(set(given) - set(chosen))
        if stray:
            raise ValueError(f"{what} of {stray} belong to no drawn component; dims are {chosen}")
    within = f"{100 * level:g} % of the {read.name}"
    for column, (axes, dim, label, scale) in enumerate(zip(panels, chosen, labels, scales, strict=True)):
        seen = masks.get(dim)
        if seen is not None:
            _shade(axes, bounds, _outages(seen, seconds, gap))
        values = None
        if readings is not None and dim in readings:
            values = number(readings[dim]).reshape(-1, 1)
            if len(values) != len(seconds):
                raise ValueError(f"readings of component {dim} must be [{len(seconds)}]; got {len(values)}")
            values = _beside(values, mean[:, [column]], [angular[column]])[:, 0]
            if seen is not None:
                values = values.where(seen, torch.nan)
        line, turns = mean[:, column], [0]
        if angular[column]:
            turns = _turns([mean, lower, upper, true], column)
        for turn in turns:
            away, named = 2 * np.pi * turn, turn == turns[0]
            if lower is not None and upper is not None:
                low, high = ((scale * (edge[:, column] - away)).numpy() for edge in (lower, upper))
                style: dict[str, Any] = {"color": BELIEF, "alpha": 0.3, "linewidth": 0}
                axes.fill_between(seconds, low, high, **style, label=within if named else None)
            if values is not None:
                shown = values.isfinite()
                dots = (scale * (values[shown] - away)).numpy()
                style = {"color": READING, "markersize": 3.5, "label": "readings" if named else None}
                axes.plot(seconds[shown.numpy()], dots, ".", **style)
            if true is not None:
                style = {"color": TRUTH, "linewidth": 1.2, "label": "truth" if named else None}
                axes.plot(seconds, (scale * (true[:, column] - away)).numpy(), **style)
            style = {"color": BELIEF, "linewidth": 1.4, "label": read.name if named else None}
            axes.plot(seconds, (scale * (line - away)).numpy(), **style)
        if len(turns) > 1:  # values beyond half a turn are wrapped to the other end
            axes.set_ylim(-np.pi * scale, np.pi * scale)
            axes.set_yticks(scale * np.linspace(-np.pi, np.pi, 5))
        axes.set_ylabel(label)
        axes.set_xlim(bounds[0], bounds[-1])
    label_below(panels, "step" if time is None else "time, s")
    if legend:
        legend_above(*panels)
    return panels


def _seen(read: Belief) -> Tensor | None:
    """Returns the steps at which anything was observed, ``[T]``."""
    return None if read.observed is None else read.observed.any(-1)


def _masks(run: TensorDictBase | Tensor, observed: Mapping[int, TensorOrKey]) -> dict[int, Tensor | None]:
    """Returns the steps at which each component's sensor observed, ``[T]``."""
    return {dim: _seen(read_belief(run, None, mask, one_sequence=True)) for dim, mask in observed.items()}


def _edges(
    read: Belief, dims: list[int], angular: list[bool], level: float, band: str
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Returns mean, lower and upper end of the band, each ``[T, K]``."""
    if band not in ("auto", "ensemble", "variance"):
        raise ValueError(f'band must be "auto", "ensemble" or "variance"; got {band!r}')
    if not 0 < level < 1:
        raise ValueError(f"level is the probability of the band, in (0, 1); got {level}")
    mean = read.mean[:, dims]
    for column, turns in enumerate(angular):
        if turns:
            mean[:, column] = _unwrap(mean[:, column])
    size = read.ensemble_size
    if band == "ensemble" and size is None:
        raise ValueError('band="ensemble" needs ("belief", "ensemble") of equal weights; pass band="variance"')
    if band == "variance" and read.var is None:
        raise ValueError('band="variance" needs ("belief", "var")')
    if size is not None and (band == "ensemble" or (band == "auto" and level <= (size - 1) / (size + 1))):
        assert read.ensemble is not None
        members = _beside(read.ensemble[..., dims], mean.unsqueeze(1), angular)
        return mean, *ensemble_interval(members, level=level)
    if read.var is None:
        return mean, None, None
    half = torch.special.ndtri(torch.tensor(0.5 + level / 2, dtype=torch.float64)) * read.var[:, dims].sqrt()
    return mean, mean - half, mean + half


def _unwrap(angle: Tensor) -> Tensor:
    out, known = angle.clone(), angle[angle.isfinite()]
    out[angle.isfinite()] = torch.cat([known[:1], known[:1] + wrap_angles(known.diff()).cumsum(0)])
    return out


def _turns(drawn: Sequence[Tensor | None], column: int) -> list[int]:
    """Returns the turns that a column of unwrapped angles ``[T, K]`` covers; turn 0 is -pi to pi."""
    values = torch.cat([value[:, column] for value in drawn if value is not None])
    values = values[values.isfinite()]
    if not len(values):
        return [0]
    first, last = (int(((end + np.pi) / (2 * np.pi)).floor()) for end in (values.min(), values.max()))
    return list(range(first, last + 1))


def _beside(values: Tensor, mean: Tensor, angular: list[bool]) -> Tensor:
    """Returns the values; angles brought within π of the mean."""
    turned = torch.tensor(angular)
    return torch.where(turned, mean + wrap_angles(values - mean), values)


def _outages(seen: Tensor, seconds: np.ndarray, gap: float | None) -> np.ndarray:
    """Returns the first step of each outage, and the step after its last, ``[K, 2]``."""
    change = np.diff(np.concatenate([[0], (~seen).numpy().astype(int), [0]]))
    first, last = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 1.0
    # Assumes a reading one step before the first step, and one step after the last.
    around = np.concatenate([[seconds[0] - step], seconds, [seconds[-1] + step]])
    if gap is None:
        readings = seconds[seen.numpy()]
        gap = 1.5 * float(np.median(np.diff(readings))) if len(readings) > 1 else 0.0
    elif not gap >= 0:
        raise ValueError(f"gap is the longest time between two readings that is no outage, at least 0; got {gap}")
    longer = around[last + 1] - around[first] > gap
    return np.stack([first[longer], last[longer]], -1)


def _shade(axes: Axes, bounds: np.ndarray, outages: np.ndarray) -> None:
    """Shades outages, one span each."""
    for first, last in outages:
        label = None if axes.patches else "not observed"
        axes.axvspan(bounds[first], bounds[last], color=UNSEEN, linewidth=0, zorder=0.5, label=label)
