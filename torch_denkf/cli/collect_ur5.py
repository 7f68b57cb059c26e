"""``denkf collect-ur5``: demonstrations of the UR5 table.

::

    denkf collect-ur5 --demos 2000 --size 224 --out demos               # whole sequences
    denkf collect-ur5 --demos 2000 --size 112 --frames 8 --out frames   # for a sensor
    denkf collect-ur5 --out demos --verify                              # checksums
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from torch_denkf._progress import progress_bar
from torch_denkf.data.ur5 import files
from torch_denkf.envs.ur5.collect import EPISODE, collect_ur5_demos
from torch_denkf.simulation.ur5.names import DOMAIN_NAMES, TASKS

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: words of the command line; by default the process's own.

    Returns:
        The exit status: 0; 1 if ``--verify`` finds damaged files, named on stderr; 2 with a message on stderr; 130
        when interrupted.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> main(["--out", folder, "--demos", "1", "--no-pixels", "--processes", "1"])
        1 demos in ...: 1 made, 0 were there; 0 failed episodes left out
        0
        >>> main(["--out", folder, "--verify"])
        1 demos in ...: all checksums are right
        0
    """
    parser = argparse.ArgumentParser(
        prog=files.COMMAND,
        description="Collect demonstrations of the UR5 table; a repeated command goes on where the last one ended.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--out", required=True, type=Path, help="folder of the demos")
    parser.add_argument("--demos", type=int, default=2000, help="that the folder shall have")
    parser.add_argument(
        "--size", nargs="+", type=int, default=[224], metavar="PX", help="one side, or height and width"
    )
    parser.add_argument("--frames", type=int, default=0, help="random steps of each demo to draw; 0 for all")
    parser.add_argument("--no-pixels", action="store_true", help="states and actions alone")
    parser.add_argument("--domain", choices=DOMAIN_NAMES, default="sim", help="of the environment")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="in turn")
    parser.add_argument("--seed", type=int, default=0, help="another one gives other demos")
    parser.add_argument("--max-steps", type=int, default=EPISODE, help="of each demo that are kept")
    parser.add_argument("--noise", type=float, default=0.0, help="of the expert's joint targets, rad")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="that collect at a time")
    parser.add_argument("--verify", action="store_true", help="check the files that are there and make none")
    args = parser.parse_args(arguments)
    if args.verify:
        return _verify(args.out)
    try:
        with progress_bar("collecting", args.demos, unit=" demos") as bar:
            made = collect_ur5_demos(
                args.out,
                args.demos,
                size=tuple(args.size * 2 if len(args.size) == 1 else args.size),
                frames=None if args.no_pixels else args.frames,
                domain=args.domain,
                tasks=args.tasks,
                seed=args.seed,
                max_steps=args.max_steps,
                noise=args.noise,
                processes=args.processes,
                progress=bar.update,
            )
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; the same command goes on from here\n")
        return 130
    failures = sum(entry.failures for entry in files.read_manifest(args.out).values())
    sys.stdout.write(
        f"{args.demos} demos in {args.out}: {made} made, {args.demos - made} were there; "
        f"{failures} failed episodes left out\n"
    )
    return 0


def _verify(root: Path) -> int:
    try:
        entries = files.read_manifest(root).values()
    except OSError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    if not entries:
        sys.stderr.write(f"error: no demos in {root}: no {files.MANIFEST}, or an empty one\n")
        return 2
    wrong = [text for text in (files.what_is_wrong(root, entry) for entry in entries) if text is not None]
    sys.stderr.write("".join(f"{text}\n" for text in wrong))
    found = f"{len(wrong)} are missing or damaged" if wrong else "all checksums are right"
    sys.stdout.write(f"{len(entries)} demos in {root}: {found}\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
