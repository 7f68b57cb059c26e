"""Figure of a video."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from torch_denkf.plots._axes import BELIEF, READING, new_figure, step_bounds
from torch_denkf.plots._frames import as_picture

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D


class Scene:
    """Figure of a video: everything is drawn once, and each frame shows the data until its time."""

    def __init__(
        self,
        size: tuple[float, float],
        dpi: float,
        title: str | None,
        pictures: Tensor | np.ndarray | None,
        path: bool,
        bands: int,
        on_picture: bool = False,
    ):
        figure = new_figure(size)
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        figure.set_dpi(dpi)
        self.canvas, self.figure, self.pictures = FigureCanvasAgg(figure), figure, pictures
        left = (pictures is not None) + (path and not on_picture)
        columns = figure.add_gridspec(1, 2 if left and bands else 1, width_ratios=[1, 1.25] if left and bands else None)
        self.camera = self.path = None
        if left:
            rows = columns[0, 0].subgridspec(left, 1, height_ratios=[1, 1.6] if left == 2 else None)
            if pictures is not None:
                self.camera = figure.add_subplot(rows[0])
                self.image = self.camera.imshow(as_picture(pictures[0]), interpolation="nearest")
                self.camera.set(xticks=[], yticks=[])
            if on_picture:
                self.path = self.camera
            elif path:
                self.path = figure.add_subplot(rows[-1])
        self.bands: list[Axes] = []
        if bands:
            grid = columns[0, -1].subgridspec(bands, 1)
            for row in range(bands):
                self.bands.append(figure.add_subplot(grid[row], sharex=self.bands[0] if row else None))
                self.bands[row].tick_params(labelbottom=row == bands - 1)
        if title is not None:
            figure.suptitle(title)

    def freeze(self, seen: Tensor | None, seconds: np.ndarray) -> None:
        """Fixes layout and limits, and draws the static parts once, with and without the bands."""
        self.seen, self.bounds = seen, step_bounds(seconds)
        if self.camera is not None:  # the path does not change the image's limits
            height, width = self.image.get_size()
            self.camera.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="", ylabel="")
            self.camera.set_aspect("equal", adjustable="box")
        self._shrink_labels()
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")
        drawn = [axes for axes in (self.path, *self.bands) if axes is not None]
        for axes in drawn:
            axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())
        self.lines: list[tuple[Line2D, np.ndarray]] = []
        self.moving: list[tuple[Axes, Artist]] = []
        if self.camera is not None:
            self.note = self.camera.annotate(
                "", (0.5, 0), (0, -3), "axes fraction", "offset points", color=READING, ha="center", va="top"
            )
            self.moving += [(self.camera, part) for part in (self.image, *self.camera.spines.values(), self.note)]
        if self.path is not None:
            if self.path is self.camera:
                self._outline_lines()
            else:
                self.path.set_aspect("auto")  # the limits are those of equal scales
            self.lines = [(line, np.asarray(line.get_data())) for line in self.path.get_lines()]
            self.lines = [(line, data) for line, data in self.lines if data.shape[1] == len(seconds)]
            self.here = self.path.plot([], [], "o", color=BELIEF, markersize=5, zorder=3)[0]
            grow = [*self.path.patches, *(line for line, _ in self.lines), self.here]
            self.moving += [(self.path, part) for part in sorted(grow, key=lambda part: part.get_zorder())]
        for _, part in self.moving:
            part.set_animated(True)
        self.all_bands = self._picture()
        for axes in self.bands:
            for artist in (*axes.lines, *axes.collections, *axes.patches):
                artist.set_visible(False)
        self._picture()
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def _outline_lines(self) -> None:
        """Outlines the lines on the image in white, for dark images."""
        from matplotlib.patheffects import withStroke

        for line in self.camera.get_lines() if self.camera is not None else ():
            if line.get_alpha() is None:
                line.set_path_effects([withStroke(linewidth=line.get_linewidth() + 1, foreground="white")])

    def _shrink_labels(self) -> None:
        """Shrinks the bands' labels to fit next to their Axes, all in the same size."""
        self.figure.draw_without_rendering()
        labels = [axes.yaxis.label for axes in self.bands]
        needed = [label.get_window_extent().height for label in labels]
        room = [
            axes.get_window_extent().height / max(height, 1.0) for axes, height in zip(self.bands, needed, strict=True)
        ]
        for label in labels:
            label.set_fontsize(float(label.get_fontsize()) * min(1.0, *room))

    def _picture(self) -> np.ndarray:
        self.canvas.draw()
        return self._buffer()

    def _buffer(self) -> np.ndarray:
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    def frame(self, step: int) -> np.ndarray:
        """Returns the picture of one step, ``[H, W, 3]`` uint8."""
        if self.camera is not None and self.pictures is not None:
            self.image.set_data(as_picture(self.pictures[step]))
            unseen = self.seen is not None and not bool(self.seen[step])
            self.note.set_text("not observed" if unseen else "")
            for spine in self.camera.spines.values():
                spine.set(color=READING if unseen else "black", linewidth=3 if unseen else 0.8)
        for line, data in self.lines:
            line.set_data(data[:, : step + 1])
            if line.get_gid() == "belief":
                self.here.set_data(data[:, step : step + 1])
        if self.path is not None:
            for patch in self.path.patches:
                patch.set_visible(int(str(patch.get_gid()).removeprefix("step ")) <= step)
        self.canvas.restore_region(self.background)
        for axes, part in self.moving:
            axes.draw_artist(part)
        picture = self._buffer()
        for axes in self.bands:
            self._uncover(picture, axes, self.bounds[step + 1])
        return picture

    def _uncover(self, picture: np.ndarray, axes: Axes, until: float) -> None:
        """Copies the drawing in the Axes left of ``until`` into the image."""
        box, height = axes.get_window_extent(), len(picture)
        right = min(axes.transData.transform((until, 0))[0], box.x1)
        rows, columns = slice(round(height - box.y1), round(height - box.y0)), slice(round(box.x0), round(right))
        picture[rows, columns] = self.all_bands[rows, columns]
