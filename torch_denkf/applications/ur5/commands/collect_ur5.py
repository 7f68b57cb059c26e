"""``denkf collect-ur5``: demonstrations of the UR5 table.

::

    denkf collect-ur5 --demos 2000 --size 224 --out demos               # whole sequences
    denkf collect-ur5 --demos 2000 --size 112 --frames 8 --out frames   # for a sensor
    denkf collect-ur5 --out demos --verify                              # checksums

From Python:

>>> import tempfile
>>> folder = tempfile.mkdtemp()
>>> CollectUR5.main(["--out", folder, "--demos", "1", "--no-pixels", "--processes", "1"])
1 demos in ...: 1 made, 0 were there; 0 failed episodes left out
0
>>> CollectUR5.main(["--out", folder, "--verify"])
1 demos in ...: all checksums are right
0
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from torch_denkf._checks import check_count
from torch_denkf.applications.ur5.data import files
from torch_denkf.applications.ur5.envs.collect import EPISODE, collect_ur5_demos
from torch_denkf.applications.ur5.simulation.names import TASKS, DomainName, TaskName
from torch_denkf.cli.command import Command, say
from torch_denkf.deployment.progress import progress_bar

__all__ = ["CollectUR5"]


@dataclass
class CollectUR5(Command):
    """Collect demonstrations of the UR5 table; a repeated command continues where the last one ended."""

    out: Path  # folder of the demos
    demos: int = 2000  # that the folder shall have
    size: tuple[int, ...] = (224,)  # pixels of one side, or of height and width
    frames: int = 0  # random steps of each demo to draw; 0 for all
    pixels: bool = True  # states and actions alone
    domain: DomainName = "sim"  # of the environment
    tasks: tuple[TaskName, ...] = TASKS  # in turn
    seed: int = 0  # another one gives other demos
    max_steps: int = EPISODE  # of each demo that are kept
    noise: float = 0.0  # of the expert's joint targets, rad
    processes: int = os.cpu_count() or 1  # that collect at a time
    verify: bool = False  # check the files that are there and make none

    name, resumable, mistakes = "collect-ur5", True, (RuntimeError,)
    example = "denkf collect-ur5 --demos 2000 --size 224 --frames 16 --out demos"

    def run(self) -> int:
        """Collects or verifies."""
        if self.verify:
            return _verify(self.out)
        check_count("--frames", self.frames, least=0)
        with progress_bar("collecting", self.demos, unit=" demos") as bar:
            made = collect_ur5_demos(
                self.out,
                self.demos,
                size=self.size * 2 if len(self.size) == 1 else self.size,  # type: ignore[arg-type]
                frames=self.frames if self.pixels else None,
                domain=self.domain,
                tasks=self.tasks,
                seed=self.seed,
                max_steps=self.max_steps,
                noise=self.noise,
                processes=self.processes,
                progress=bar.update,
            )
        failures = sum(entry.failures for entry in files.read_manifest(self.out).values())
        say(
            f"{self.demos} demos in {self.out}: {made} made, {self.demos - made} were there; "
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
