"""A car's drive with a failing camera: picture, map and velocities in one figure, as a still or an animation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from tensordict import TensorDictBase
from torch import Tensor

from torch_denkf.plots._axes import BELIEF, FILL, READING, TRUTH, new_figure
from torch_denkf.plots._frames import as_picture
from torch_denkf.plots.video import write_video

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["NamedSpan", "drive_animation", "drive_picture"]

_LEVEL = 1.645  # standard deviations of the 90 % interval
_ELLIPSE = math.sqrt(-2 * math.log(0.1))  # of the 90 % ellipse
_RECKONED, _MEMBERS = "#CC79A7", "#56B4E9"  # Okabe & Ito
_SHADES = ("#F9D3B4", "#D5D5D5", "#FFEB85")
_PANELS = ((3, "speed, m/s", 1.0), (4, "turn rate, deg/s", math.degrees(1)))
_PATHS = ("truth", "dead reckoning (last reading held)", "filter: best guess")


class NamedSpan(NamedTuple):
    """A stretch of steps with a name, such as a failure of the camera.

    Attributes:
        name: in plain words; a line break is kept.
        first: number of the first step.
        last: number of the last step.
    """

    name: str
    first: int
    last: int


def drive_picture(
    tracked: TensorDictBase, images: Sequence[Tensor | np.ndarray], spans: Sequence[NamedSpan], title: str = ""
) -> Figure:
    """A still of the whole drive: what the camera showed at four times, the map, and the velocities with 90 % bands.

    Args:
        tracked: ``[T]`` with ``"belief"`` (``"mean"`` ``[T, 5]``, ``"var"``, ``"ensemble"`` ``[T, E, 5]``), ``"state"``
            ``[T, 5]``, ``"dead_reckoning"`` ``[T, 3]`` and ``"time"`` ``[T, 1]``, such as
            :func:`torch_denkf.applications.car.odometry.failing_drive.track_failing_drive` returns; the state is a
            car's [x, y, theta, v, theta_dot].
        images: of the steps, as the camera showed them.
        spans: failures of the camera; at most three are pictured.
        title: headline.

    Returns:
        The figure; ``figure.savefig("drive.png")`` writes it.

    Raises:
        ImportError: without matplotlib; the message names the extra.
    """
    figure = new_figure((9, 6.4))
    shown = [NamedSpan("camera works", 0, 2 * (spans[0].first // 4) if spans else 0), *spans[:3]]
    grid = figure.add_gridspec(2, 1, height_ratios=[1, 4.4])
    top = grid[0].subgridspec(1, len(shown))
    for column, span in enumerate(shown):
        axes = figure.add_subplot(top[column])
        colour = "black" if column == 0 else _SHADES[(column - 1) % len(_SHADES)]
        _camera(axes, images[(span.first + span.last) // 2], span.name.replace("\n", " "), colour)
    below = grid[1].subgridspec(2, 2, width_ratios=[1, 1.15])
    drive = _Drive(tracked, spans)
    below_map = figure.add_subplot(below[:, 0])
    drive.draw_map(below_map)
    panels = [figure.add_subplot(below[row, 1]) for row in range(2)]
    drive.draw_panels(panels, named=True)
    _legend(figure, below_map, 3)
    figure.suptitle(title, fontsize=12)
    return figure


def drive_animation(
    file: str | Path,
    tracked: TensorDictBase,
    images: Sequence[Tensor | np.ndarray],
    spans: Sequence[NamedSpan],
    *,
    title: str = "",
    every: int = 4,
    fps: float = 6,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """An animation of the drive, as it happened.

    Args:
        file: ``.gif`` or ``.mp4``, see :func:`torch_denkf.plots.write_video`.
        tracked: see :func:`drive_picture`.
        images: of the steps, as the camera showed them.
        spans: failures of the camera.
        title: headline.
        every: draw every n-th step.
        fps: frames a second.
        progress: called with the number of frames since the last call.

    Returns:
        The file.

    Raises:
        ImportError: without matplotlib or pillow; the message names the extra.
    """
    scene = _Animation(tracked, images, spans, title)
    count = len(images)
    steps = [*range(0, count - 1, every), *[count - 1] * round(fps)]  # the end is held

    def frames() -> Iterator[np.ndarray]:
        for step in steps:
            yield scene.frame(step)
            if progress is not None:
                progress(1)

    return write_video(file, frames(), fps)


class _Drive:
    """What is drawn, as arrays: the map is seen from above, forward is up."""

    def __init__(self, tracked: TensorDictBase, spans: Sequence[NamedSpan]):
        self.spans = spans
        self.time = tracked["time"].flatten().numpy()
        self.truth, self.mean = tracked["state"].numpy(), tracked["belief", "mean"].numpy()
        self.std = tracked["belief", "var"].sqrt().numpy()
        self.members = tracked["belief", "ensemble"].numpy()
        self.reckoned = tracked["dead_reckoning"].numpy()

    def draw_map(self, axes: Axes) -> dict[str, Any]:
        """Draws paths, members and failures; returns what can move."""
        parts: dict[str, Any] = {"members": [], "spans": []}
        for number, span in enumerate(self.spans):
            style: dict[str, Any] = {
                "color": _SHADES[number % 3],
                "linewidth": 15,
                "solid_capstyle": "butt",
                "zorder": 0,
            }
            part = self.truth[span.first : span.last + 1]
            parts["spans"].append(axes.plot(-part[:, 1], part[:, 0], **style)[0])
        for index in range(self.members.shape[1]):
            path = self.members[:, index]
            (line,) = axes.plot(-path[:, 1], path[:, 0], color=_MEMBERS, alpha=0.25, linewidth=0.7, zorder=1)
            parts["members"].append(line)
        parts["members"][0].set_label(f"filter: its {len(parts['members'])} possible paths")
        styles: tuple[dict[str, Any], ...] = (
            {"color": TRUTH, "linewidth": 2.2},
            {"color": _RECKONED, "linewidth": 1.8, "linestyle": "--"},
            {"color": BELIEF, "linewidth": 1.8},
        )
        for name, path, style in zip(_PATHS, (self.truth, self.reckoned, self.mean), styles, strict=True):
            (parts[name],) = axes.plot(-path[:, 1], path[:, 0], label=name, **style)
        parts["ellipse"] = self._ellipse(axes, len(self.mean) - 1)
        (parts["car"],) = axes.plot([-self.mean[-1, 1]], [self.mean[-1, 0]], "o", color=BELIEF, markersize=5, zorder=4)
        axes.plot([0], [0], "s", color="black", markersize=6, zorder=4)
        axes.annotate("start", (0, 0), (0, -14), textcoords="offset points", fontsize=9, ha="center")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="to the right, m", ylabel="forward, m")
        axes.margins(0.14)
        axes.grid(alpha=0.25)
        return parts

    def _ellipse(self, axes: Axes, step: int):
        from matplotlib.patches import Ellipse

        centre, width, height, angle = self.ellipse_at(step)
        patch = Ellipse(centre, width, height, angle=angle, facecolor=BELIEF, alpha=0.22, zorder=3)
        patch.set_label("filter: 90 %")
        axes.add_patch(patch)
        return patch

    def ellipse_at(self, step: int) -> tuple[tuple[float, float], float, float, float]:
        """Centre, both diameters and angle of the members' 90 % ellipse."""
        points = np.stack([-self.members[step, :, 1], self.members[step, :, 0]], -1)
        squares, directions = np.linalg.eigh(np.cov(points.T) + 1e-9 * np.eye(2))
        small, large = 2 * _ELLIPSE * np.sqrt(squares)
        angle = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
        return (-float(self.mean[step, 1]), float(self.mean[step, 0])), float(large), float(small), angle

    def draw_panels(self, panels: Sequence[Axes], *, named: bool) -> None:
        """Draws the velocities with their bands, and the failures, with their names if asked to."""
        for row, (axes, (dim, label, factor)) in enumerate(zip(panels, _PANELS, strict=True)):
            mean, reach = factor * self.mean[:, dim], factor * _LEVEL * self.std[:, dim]
            axes.fill_between(
                self.time, mean - reach, mean + reach, color=FILL, linewidth=0, label="filter: 90 %", zorder=1
            )
            axes.plot(self.time, factor * self.truth[:, dim], color=TRUTH, linewidth=1.6, label="truth", zorder=2)
            axes.plot(self.time, mean, color=BELIEF, linewidth=1.4, label="filter: best guess", zorder=3)
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + (0.28 if named and row == 0 else 0.05) * (high - low))
            axes.set(ylabel=label, xlim=(self.time[0], self.time[-1]))
            for number, span in enumerate(self.spans):
                edges = self.time[span.first], self.time[span.last]
                axes.axvspan(*edges, color=_SHADES[number % 3], linewidth=0, zorder=0)
                if named and row == 0:
                    style: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 8}
                    axes.text(sum(edges) / 2, 0.98, span.name, transform=axes.get_xaxis_transform(), **style)
        panels[0].tick_params(labelbottom=False)
        panels[1].set_xlabel("time, s")


class _Animation:
    """One figure, of which each frame shows what has happened until then."""

    def __init__(
        self,
        tracked: TensorDictBase,
        images: Sequence[Tensor | np.ndarray],
        spans: Sequence[NamedSpan],
        title: str,
    ):
        figure = new_figure((8, 5))
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        figure.set_dpi(100)
        self.canvas, self.images, self.spans = FigureCanvasAgg(figure), images, spans
        figure.suptitle(title, fontsize=11)
        columns = figure.add_gridspec(1, 2, width_ratios=[1, 1.1])
        right = columns[1].subgridspec(3, 1, height_ratios=[1.05, 1, 1])
        self.drive = _Drive(tracked, spans)
        self.map = figure.add_subplot(columns[0])
        self.parts = self.drive.draw_map(self.map)
        self.camera = figure.add_subplot(right[0])
        self.image = _camera(self.camera, images[0], "camera works", "black")
        self.panels = [figure.add_subplot(right[row]) for row in (1, 2)]
        self.drive.draw_panels(self.panels, named=False)
        _legend(figure, self.map, 3)
        self.covers = [axes.axvspan(0, self.drive.time[-1], color="white", zorder=2.4) for axes in self.panels]
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        self.map.set_aspect("auto")  # the limits are those of equal scales
        self.map.set(xlim=self.map.get_xlim(), ylim=self.map.get_ylim())
        paths = [self.parts[name] for name in _PATHS]
        moving = [*self.parts["spans"], *self.parts["members"], *paths, self.parts["ellipse"], self.parts["car"]]
        # What stands still is drawn once.
        self.moving = [(self.camera, self.image), (self.camera, self.camera.title), *((self.map, m) for m in moving)]
        self.moving += [(self.camera, edge) for edge in self.camera.spines.values()]
        self.moving += list(zip(self.panels, self.covers, strict=True))
        for _, artist in self.moving:
            artist.set_animated(True)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(figure.bbox)

    def frame(self, step: int) -> np.ndarray:
        """The picture of one step, ``[H, W, 3]`` uint8."""
        drive, until = self.drive, step + 1
        span = next((each for each in self.spans if each.first <= step <= each.last), None)
        self.image.set_data(as_picture(self.images[step]))
        name = "camera works" if span is None else span.name.replace("\n", " ")
        self.camera.set_title(name, fontsize=10, color="black" if span is None else READING)
        for edge in self.camera.spines.values():
            edge.set(color="black" if span is None else READING, linewidth=0.8 if span is None else 3)
        for name, path in zip(_PATHS, (drive.truth, drive.reckoned, drive.mean), strict=True):
            self.parts[name].set_data(-path[:until, 1], path[:until, 0])
        for each, line in zip(self.spans, self.parts["spans"], strict=True):
            part = drive.truth[each.first : max(min(each.last, step) + 1, each.first)]
            line.set_data(-part[:, 1], part[:, 0])
        for index, line in enumerate(self.parts["members"]):
            line.set_data(-drive.members[:until, index, 1], drive.members[:until, index, 0])
        centre, width, height, angle = drive.ellipse_at(step)
        self.parts["ellipse"].set(center=centre, width=width, height=height, angle=angle)
        self.parts["car"].set_data([centre[0]], [centre[1]])
        for cover in self.covers:
            cover.set_x(drive.time[step])
            cover.set_width(drive.time[-1] - drive.time[step])
        self.canvas.restore_region(self.background)
        for axes, artist in self.moving:
            axes.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()


def _camera(axes: Axes, image: Tensor | np.ndarray, name: str, colour: str):
    shown = axes.imshow(as_picture(image), interpolation="bilinear", aspect="auto")
    axes.set(xticks=[], yticks=[])
    axes.set_title(name, fontsize=9.5)
    for edge in axes.spines.values():
        edge.set(color=colour, linewidth=5 if colour != "black" else 0.8)
    return shown


def _legend(figure: Figure, axes: Axes, columns: int) -> None:
    """One legend for all, below."""
    handles, labels = axes.get_legend_handles_labels()
    order = [labels.index(name) for name in (*_PATHS[::2], labels[0], "filter: 90 %", _PATHS[1])]
    style: dict[str, Any] = {"loc": "outside lower center", "ncols": columns, "fontsize": 9, "frameon": False}
    shown = figure.legend([handles[n] for n in order], [labels[n] for n in order], **style)
    for line in shown.get_lines():
        line.set_alpha(1.0)
