"""``denkf render-kitti``: drives in KITTI's layout.

::

    denkf render-kitti --poses kitti/poses --out rendered        # along recorded poses
    denkf render-kitti --names a b c --frames 1000 --out town    # along invented ones

A repeated or interrupted command goes on with the drives that are missing. See
:func:`torch_denkf.data.render_drives`, which does the work.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from torch_denkf._progress import progress_bar
from torch_denkf.data.kitti.render import GREY_OR_COLOUR, render_drives
from torch_denkf.simulation.street.camera import KITTI_FOCAL

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: words of the command line; by default the process's own.

    Returns:
        The exit status: 0, or 2 with a message on stderr.

    Examples:
        >>> import tempfile
        >>> main(["--out", tempfile.mkdtemp(), "--names", "a", "--frames", "3", "--processes", "1"])
        0
    """
    parser = argparse.ArgumentParser(
        prog="denkf render-kitti",
        description="Render drives in KITTI's layout, along pose files or along invented trajectories.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--out", required=True, help="folder that gets sequences/ and poses/")
    parser.add_argument("--poses", help="folder of pose files NAME.txt; without it the drives are invented")
    parser.add_argument("--names", nargs="+", help="drives: all pose files, or 00 to 10 when invented")
    parser.add_argument("--size", nargs=2, type=int, default=(50, 150), metavar=("H", "W"), help="of the images")
    parser.add_argument("--frames", type=int, help="at most so many images a drive; 300 when invented")
    parser.add_argument("--seed", type=int, default=0, help="another one gives other scenes")
    parser.add_argument("--camera", choices=GREY_OR_COLOUR, default="image_2", help="image_0 is grey")
    parser.add_argument("--focal", type=float, default=KITTI_FOCAL, help="focal length as a share of the width")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="that draw at a time")
    parser.add_argument("--overwrite", action="store_true", help="replace rendered drives of other options")
    parser.add_argument("--no-traffic", action="store_true", help="no moving cars, steady exposure")
    args = parser.parse_args(arguments)
    try:
        with progress_bar("rendering", None, unit=" images") as bar:
            render_drives(
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
    except (OSError, ValueError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
