"""``denkf render-kitti``: drives in KITTI's layout.

::

    denkf render-kitti --poses kitti/poses --out rendered        # along recorded poses
    denkf render-kitti --names a b c --frames 1000 --out town    # along invented ones

A repeated or interrupted command goes on with the drives that are missing. See
:func:`torch_denkf.applications.car.kitti.render.render_drives`, which does the work. From Python:

>>> import tempfile
>>> main(["--out", tempfile.mkdtemp(), "--names", "a", "--frames", "3", "--processes", "1"])
1 drives in ...: a
0
"""

from __future__ import annotations

import argparse
import os

from torch_denkf._progress import progress_bar
from torch_denkf.applications.car.kitti.render import GREY_OR_COLOUR, render_drives
from torch_denkf.applications.car.street.camera import KITTI_FOCAL
from torch_denkf.cli._command import Command, path, say, whole

__all__ = ["main"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--out", required=True, type=path, help="folder that gets sequences/ and poses/")
    add("--poses", type=path, help="folder of pose files NAME.txt; without it the drives are invented")
    add("--names", nargs="+", help="drives: all pose files, or 00 to 10 when invented")
    add("--size", nargs=2, type=int, default=(50, 150), metavar=("H", "W"), help="of the images, such as --size 50 150")
    add("--frames", type=int, help="at most so many images a drive; 300 when invented")
    add("--seed", type=whole(0), default=0, help="another one gives other scenes")
    add("--camera", choices=GREY_OR_COLOUR, default="image_2", help="image_0 is grey")
    add("--focal", type=float, default=KITTI_FOCAL, help="focal length as a share of the width")
    add("--processes", type=int, default=os.cpu_count() or 1, help="that draw at a time")
    add("--overwrite", action="store_true", help="replace rendered drives of other options")
    add("--no-traffic", action="store_true", help="no moving cars, steady exposure")


def _run(args: argparse.Namespace) -> None:
    with progress_bar("rendering", None, unit=" images") as bar:
        names = render_drives(
            args.out,
            poses=args.poses,
            names=args.names,
            size=tuple(args.size),
            frames=args.frames,
            seed=args.seed,
            camera=args.camera,
            focal=args.focal,
            traffic=not args.no_traffic,
            processes=args.processes,
            overwrite=args.overwrite,
            progress=bar.update,
        )
    say(f"{len(names)} drives in {args.out}: {', '.join(names)}")


main = Command(
    "render-kitti",
    "Render drives in KITTI's layout, along pose files or along invented trajectories.",
    "denkf render-kitti --names a b c --frames 1000 --out town",
    _arguments,
    _run,
    resumable=True,
)

if __name__ == "__main__":
    raise SystemExit(main())
