"""``denkf plot``: plots of a path from ``denkf odometry``.

::

    denkf plot runs/drive
    denkf plot runs/drive/path.csv --out pictures

See :mod:`torch_denkf.plots`, which draws.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from torch_denkf.cli.command import Command, say
from torch_denkf.deployment.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Plot", "draw"]


@dataclass
class Plot(Command):
    """Draw the path that denkf odometry found, with ellipses, and its velocities, with bands."""

    path: Positional[Path]  # folder or CSV file from denkf odometry
    out: Path | None = None  # folder for path.png and bands.png; that of the path by default
    level: float = 0.9  # probability of the bands and ellipses

    name, example = "plot", "denkf plot runs/drive"

    def run(self) -> None:
        """Draws the plots."""
        file = self.path / "path.csv" if self.path.is_dir() else self.path
        for written in draw(file, self.out or file.parent, self.level):
            say(str(written))


def draw(file: Path, out: Path, level: float = 0.9) -> list[Path]:
    """Draws a path and its velocities.

    Args:
        file: ``path.csv``.
        out: folder for ``path.png`` and ``bands.png``; made if it does not exist.
        level: probability of the bands and ellipses.

    Returns:
        The files.

    Raises:
        FileNotFoundError: without the file.
        ImportError: without matplotlib; the message names the extra.
        ValueError: if the file cannot be read.
    """
    from torch_denkf.applications.car.odometry.paths import read_path
    from torch_denkf.plots import plot_bands, plot_path

    path = read_path(file)
    files = [out / "path.png", out / "bands.png"]
    _save(plot_path(path, spread="ellipses", forward_up=True, level=level), files[0])
    names, factors = ["v, m/s", "theta_dot, deg/s"], [1.0, math.degrees(1)]
    time = path["time"].squeeze(-1)
    _save(plot_bands(path, dims=[3, 4], names=names, factors=factors, time=time, level=level)[0], files[1])
    return files


def _save(axes: Axes, file: Path) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    with replacing(file) as beside:
        figure.savefig(beside, dpi=120)
