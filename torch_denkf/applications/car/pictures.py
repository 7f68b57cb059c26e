"""Figure of a car's drive with a failing camera: images, map, and velocities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from tensordict import TensorDictBase

from torch_denkf.plots import plot_bands, plot_path
from torch_denkf.plots._axes import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["BANDS", "NamedSpan", "drive_picture", "named_frames", "path_options"]

#: Arguments of :func:`torch_denkf.plots.plot_bands` for a car.
BANDS: dict[str, Any] = {"dims": [3, 4], "names": ["speed, m/s", "turn rate, deg/s"], "factors": [1.0, math.degrees(1)]}
_SHADES = ("#F9D3B4", "#D5D5D5", "#FFEB85")


class NamedSpan(NamedTuple):
    """Named span of steps, such as a failure of the camera.

    Attributes:
        name: label.
        first: first step.
        last: last step, included.
    """

    name: str
    first: int
    last: int


def path_options(tracked: TensorDictBase) -> dict[str, Any]:
    """Returns the arguments of :func:`torch_denkf.plots.plot_path` for a tracked drive."""
    return {"others": {"dead reckoning (last reading held)": tracked["dead_reckoning"]}, "forward_up": True}


def named_frames(images: Sequence[np.ndarray], spans: Sequence[NamedSpan]) -> list[np.ndarray]:
    """Writes the name of each frame's span, if any, in its lower left corner; frames are ``[H, W, 3]``, RGB."""
    out = []
    for step, image in enumerate(images):
        for span in spans:
            if span.first <= step <= span.last:
                image, at = np.ascontiguousarray(image), (4, image.shape[0] - 6)
                for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
                    image = cv2.putText(image.copy(), span.name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, thickness)
        out.append(image)
    return out


def drive_picture(
    tracked: TensorDictBase, images: Sequence[np.ndarray], spans: Sequence[NamedSpan], title: str = ""
) -> Figure:
    """Draws the whole drive: the camera's image at four times, the map, and velocities with 90 % bands.

    Args:
        tracked: ``[T]`` with ``"belief"`` (``"mean"`` ``[T, 5]``, ``"var"``, ``"ensemble"`` ``[T, E, 5]``), ``"state"``
            ``[T, 5]``, ``"dead_reckoning"`` ``[T, 3]`` and ``"time"`` ``[T, 1]``, such as
            :func:`torch_denkf.applications.car.odometry.failing_drive.track_failing_drive` returns; the state is a
            car's [x, y, theta, v, theta_dot].
        images: images of the camera at the steps.
        spans: failures of the camera; at most three are drawn.
        title: title of the figure.

    Returns:
        The figure; ``figure.savefig("drive.png")`` writes it.

    Raises:
        ImportError: without matplotlib; the message names the extra.
    """
    figure = new_figure((9, 6.4))
    shown = [NamedSpan("camera works", 0, 2 * (spans[0].first // 4) if spans else 0), *spans[:3]]
    grid = figure.add_gridspec(2, 1, height_ratios=[1, 4.4])
    top, below = grid[0].subgridspec(1, len(shown)), grid[1].subgridspec(2, 2, width_ratios=[1, 1.15])
    for column, span in enumerate(shown):
        axes = figure.add_subplot(top[column])
        axes.imshow(images[(span.first + span.last) // 2], interpolation="bilinear", aspect="auto")
        axes.set(xticks=[], yticks=[])
        axes.set_title(span.name, fontsize=9.5)
        for edge in axes.spines.values() if column else ():
            edge.set(color=_SHADES[column - 1], linewidth=5)
    plot_path(tracked, ax=figure.add_subplot(below[:, 0]), **path_options(tracked))
    panels = [figure.add_subplot(below[row, 1]) for row in range(2)]
    time = tracked["time"].flatten()
    plot_bands(tracked.exclude("observed"), time=time, ax=panels, **BANDS)
    for axes in panels:
        for shade, span in zip(_SHADES, spans, strict=False):
            edges = float(time[span.first]), float(time[span.last])
            axes.axvspan(*edges, color=shade, linewidth=0, zorder=0.4, gid=span.name)
    figure.suptitle(title, fontsize=12)
    return figure
