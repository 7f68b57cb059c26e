"""``denkf collect-ur5``: demonstrations of the UR5 table.

::

    denkf collect-ur5 --demos 2000 --size 224 --out demos               # whole sequences
    denkf collect-ur5 --demos 2000 --size 112 --frames 8 --out frames   # for a sensor
    denkf collect-ur5 --out demos --verify                              # checksums

From Python:

>>> import tempfile
>>> folder = tempfile.mkdtemp()
>>> main(["--out", folder, "--demos", "1", "--no-pixels", "--processes", "1"])
1 demos in ...: 1 made, 0 were there; 0 failed episodes left out
0
>>> main(["--out", folder, "--verify"])
1 demos in ...: all checksums are right
0
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from torch_denkf._progress import progress_bar
from torch_denkf.applications.ur5.data import files
from torch_denkf.applications.ur5.envs.collect import EPISODE, collect_ur5_demos
from torch_denkf.applications.ur5.simulation.names import DOMAIN_NAMES, TASKS
from torch_denkf.cli._command import Command, path, say, whole

__all__ = ["main"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--out", required=True, type=path, help="folder of the demos")
    add("--demos", type=int, default=2000, help="that the folder shall have")
    add("--size", nargs="+", type=int, default=[224], metavar="PX", help="one side, or height and width")
    add("--frames", type=whole(0), default=0, help="random steps of each demo to draw; 0 for all")
    add("--no-pixels", action="store_true", help="states and actions alone")
    add("--domain", choices=DOMAIN_NAMES, default="sim", help="of the environment")
    add("--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="in turn")
    add("--seed", type=whole(0), default=0, help="another one gives other demos")
    add("--max-steps", type=int, default=EPISODE, help="of each demo that are kept")
    add("--noise", type=float, default=0.0, help="of the expert's joint targets, rad")
    add("--processes", type=int, default=os.cpu_count() or 1, help="that collect at a time")
    add("--verify", action="store_true", help="check the files that are there and make none")


def _run(args: argparse.Namespace) -> int:
    if args.verify:
        return _verify(args.out)
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
    failures = sum(entry.failures for entry in files.read_manifest(args.out).values())
    say(
        f"{args.demos} demos in {args.out}: {made} made, {args.demos - made} were there; "
        f"{failures} failed episodes left out"
    )
    return 0


def _verify(root: Path) -> int:
    entries = files.read_manifest(root).values()
    if not entries:
        raise FileNotFoundError(f"no demos in {root}: no {files.MANIFEST}, or an empty one")
    wrong = [text for text in (files.what_is_wrong(root, entry) for entry in entries) if text is not None]
    listed = {entry.file for entry in entries}
    others = sorted(file.name for file in root.glob(files.PATTERN) if file.name not in listed)
    wrong += [f"{root / name} is not listed in {files.MANIFEST}; {files.AGAIN}" for name in others]
    sys.stderr.write("".join(f"{text}\n" for text in wrong))
    found = f"{len(wrong)} are missing, damaged or not listed" if wrong else "all checksums are right"
    say(f"{len(entries)} demos in {root}: {found}")
    return 1 if wrong else 0


main = Command(
    "collect-ur5",
    "Collect demonstrations of the UR5 table; a repeated command goes on where the last one ended.",
    "denkf collect-ur5 --demos 2000 --size 224 --frames 16 --out demos",
    _arguments,
    _run,
    resumable=True,
    mistakes=(RuntimeError,),
)


if __name__ == "__main__":
    raise SystemExit(main())
