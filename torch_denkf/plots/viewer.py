"""A roll-out as a stream for the viewer rerun: pictures, path, ensemble and truth, to scroll through in time."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.plots._axes import labels_for, times_of
from torch_denkf.plots._belief import Truth, dims_of, read_belief, with_truth
from torch_denkf.plots._frames import as_picture
from torch_denkf.plots._pixels import find_pixels

__all__ = ["log_rollout"]

_BELIEF, _TRUTH, _MEMBERS = (0, 114, 178), (0, 0, 0), (86, 180, 233)  # Okabe & Ito's blue, black, sky blue


def log_rollout(
    belief: TensorDictBase | Tensor,
    pixels: Tensor | np.ndarray | NestedKey | None = None,
    *,
    truth: Truth = None,
    observed: Truth = None,
    dims: Sequence[int] = (0, 1),
    components: Sequence[int] | None = None,
    names: Sequence[str] | None = None,
    time: float | Tensor | None = None,
    file: str | Path | None = None,
    recording: Any = None,
) -> Any:
    """Logs one sequence to rerun: https://rerun.io.

    =========================== ======================================================================================
    entity                      content
    =========================== ======================================================================================
    ``camera``                  the picture of the step
    ``path/truth``              the whole true path, and ``path/truth/now`` where it is
    ``path/belief``             the whole path of the mean, and ``path/belief/now`` where it is
    ``path/ensemble``           the members
    ``components/NAME/mean``    each component's mean, and beside it ``low``, ``high`` (mean ± 1.645 standard
                                deviations) and ``truth``
    ``observed``                1 where a reading was observed, else 0
    =========================== ======================================================================================

    Args:
        belief: a roll-out or sequence of T steps with ``("belief", "mean")`` ``[T, S]`` or ``("belief", "ensemble")``
            ``[T, E, S]``; or means ``[T, S]``.
        pixels: pictures, see :func:`torch_denkf.plots.belief_video`.
        truth: ``[T, S']``, or its key; by default ``"state"`` of the roll-out where it is there.
        observed: ``[T, 1]`` bool, or its key; by default ``"observed"`` of the roll-out where it is there.
        dims: of the state, two coordinates of the path on the ground, or three in space.
        components: of the state, to log over time; all by default.
        names: a label for each of them.
        time: seconds of the steps ``[T]``, or the seconds between two. The timeline ``"step"`` is always there,
            ``"time"`` only with this.
        file: ``.rrd`` to write; ``rerun FILE`` shows it.
        recording: a ``rerun.RecordingStream`` to log into, such as one that is connected to a viewer; ``None`` makes
            one, which keeps the data in memory where there is no ``file``.

    Returns:
        The recording; ``rerun.notebook_show(recording=...)`` shows it in a notebook.

    Raises:
        ImportError: without rerun-sdk; the message names the extra.
        KeyError: if the roll-out lacks a key that was named.
        ValueError: for more than one sequence, and for shapes that do not fit.
        IndexError: if ``dims`` or ``components`` names no dimension.

    Example:
        >>> log_rollout(rollout["next"], dims=[0, 1], time=0.103, file="drive.rrd")  # doctest: +SKIP
    """
    rr = _rerun()
    read = read_belief(belief, truth, observed, one_sequence=True)
    place, parts = dims_of(read, dims), dims_of(read, components)
    if len(place) not in (2, 3):
        raise ValueError(f"dims must name two or three coordinates; got {list(dims)}")
    labels = labels_for(names, parts)
    pictures = find_pixels(belief, pixels, len(read.mean))
    seconds = None if time is None else times_of(time, len(read.mean))
    if recording is None:
        recording = rr.RecordingStream("torch_denkf")
    if file is not None:
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        recording.save(str(file))
    paths = {"belief": (_in_space(read.mean[:, place]), _BELIEF)}
    if read.truth is not None:
        paths["truth"] = (_in_space(with_truth(read, place)), _TRUTH)
    recording.log("path", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for name, (path, colour) in paths.items():
        recording.log(f"path/{name}", rr.LineStrips3D([path], colors=[colour]), static=True)
    spread = None if read.var is None else 1.645 * read.var.sqrt()
    for step in range(len(read.mean)):
        recording.set_time("step", sequence=step)
        if seconds is not None:
            recording.set_time("time", duration=float(seconds[step]))
        if pictures is not None:
            recording.log("camera", rr.Image(as_picture(pictures[step])))
        for name, (path, colour) in paths.items():
            recording.log(f"path/{name}/now", rr.Points3D(path[step : step + 1], colors=[colour]))
        if read.ensemble is not None:
            recording.log("path/ensemble", rr.Points3D(_in_space(read.ensemble[step][:, place]), colors=[_MEMBERS]))
        if read.observed is not None:
            recording.log("observed", rr.Scalars(float(read.observed[step].any())))
        for dim, label in zip(parts, labels, strict=True):
            values = {"mean": float(read.mean[step, dim])}
            if spread is not None:
                values["low"] = values["mean"] - float(spread[step, dim])
                values["high"] = values["mean"] + float(spread[step, dim])
            if read.truth is not None and dim < read.truth.shape[-1]:
                values["truth"] = float(read.truth[step, dim])
            for name, value in values.items():
                recording.log(["components", label, name], rr.Scalars(value))
    recording.flush()
    return recording


def _in_space(points: Tensor) -> np.ndarray:
    """Points ``[N, 2]`` or ``[N, 3]`` in the three coordinates of a space that z points up in."""
    return np.pad(points.numpy(), ((0, 0), (0, 3 - points.shape[-1])))


def _rerun() -> Any:
    """The package rerun.

    Raises:
        ImportError: without it.
    """
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise ImportError('the viewer needs rerun-sdk: pip install "torch_denkf[viewer]"') from error
