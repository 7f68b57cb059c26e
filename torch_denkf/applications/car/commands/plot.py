"""``denkf plot``: pictures of a path that ``denkf odometry`` left.

::

    denkf plot runs/drive
    denkf plot runs/drive/path.csv --out pictures

See :mod:`torch_denkf.plots`, which draws.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from torch_denkf._files import replacing
from torch_denkf.cli._command import Command, path, say

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw", "main"]


def draw(file: Path, out: Path, level: float = 0.9) -> list[Path]:
    """Draws a path and its velocities.

    Args:
        file: ``path.csv``.
        out: folder that gets ``path.png`` and ``bands.png``; made where it is not there.
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


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("path", type=path, metavar="FOLDER_OR_CSV", help="that denkf odometry left")
    add("--out", type=path, help="folder for path.png and bands.png; that of the path by default")
    add("--level", type=float, default=0.9, help="probability of the bands and ellipses")


def _run(args: argparse.Namespace) -> None:
    file = args.path / "path.csv" if args.path.is_dir() else args.path
    for written in draw(file, args.out or file.parent, args.level):
        say(str(written))


main = Command(
    "plot",
    "Draw the path that denkf odometry found, with ellipses, and its velocities, with bands.",
    "denkf plot runs/drive",
    _arguments,
    _run,
)

if __name__ == "__main__":
    raise SystemExit(main())
