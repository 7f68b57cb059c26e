"""Runs every example and short study at tiny size, two in parallel; with ``--all`` also the long studies.

``python -m benchmarks.common.smoke``

Shared imports run once, and each run is a fork of this process: otherwise the imports take longer than most of the
runs.
"""

# ruff: noqa: F401  # imports of nearly all programs
from __future__ import annotations

import os
import runpy
import shutil
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import IO

import matplotlib.pyplot
import scipy.stats
import torchrl.collectors
import torchrl.envs
import torchrl.objectives

import torch_denkf.filters
import torch_denkf.fusion
import torch_denkf.objectives
import torch_denkf.plots
import torch_denkf.training

ROOT = Path(__file__).parents[2]
#: Studies with the longest tiny runs, which start first.
LONG = ("monitor", "ur5", "control", "kitti", "g1", "lorenz96", "reliability", "sequence07", "legged", "legged.policy")
ELSEWHERE = ("speed",)  # needs the compared libraries, see tests/benchmarks/test_speed.py
SIDE_BY_SIDE = 2


def programs() -> list[str]:
    """Returns the names of modules and the paths of files to run."""
    found = {file.parent.name for file in ROOT.glob("benchmarks/*/__main__.py")} - set(ELSEWHERE)
    studies = [*(LONG if "--all" in sys.argv else ()), *sorted(found - set(LONG))]
    return [f"benchmarks.{name}" for name in studies] + sorted(
        f"examples/{file.name}" for file in ROOT.glob("examples/*.py")
    )


def run(program: str) -> None:
    """Runs a program as ``__main__``."""
    sys.argv = [program, "--smoke"]
    if program.endswith(".py"):
        sys.path.insert(0, str(ROOT / "examples"))
        runpy.run_path(str(ROOT / program), run_name="__main__")
    else:
        runpy.run_module(program, run_name="__main__", alter_sys=True)


def start(program: str, log: IO[bytes]) -> int:
    """Runs a program in a new process, whose output goes to a file; returns its id."""
    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    os.dup2(log.fileno(), 1)
    os.dup2(log.fileno(), 2)
    try:
        run(program)
    except Exception:
        traceback.print_exc()
        sys.exit(1)
    sys.exit(0)


def main() -> None:
    """Runs all programs, prints their outputs, and deletes their files; exits with an error if one failed."""
    folder, own = tempfile.mkdtemp(), os.getpid()
    os.environ["TMPDIR"] = tempfile.tempdir = folder
    try:
        run_all()
    finally:
        if os.getpid() == own:  # a fork gets here, too
            shutil.rmtree(folder, ignore_errors=True)


def run_all() -> None:
    """Runs all programs, two in parallel."""
    waiting, running, failed = programs(), {}, []
    while waiting or running:
        while waiting and len(running) < SIDE_BY_SIDE:
            program, log = waiting.pop(0), tempfile.TemporaryFile()  # noqa: SIM115  # read when the process has ended
            running[start(program, log)] = program, log, time.monotonic()
        process, status = os.wait()
        program, log, began = running.pop(process)
        log.seek(0)
        text = log.read().decode(errors="replace")
        log.close()
        code = os.waitstatus_to_exitcode(status)
        failed += [program] * (code != 0)
        print(f"== {program} --smoke: {code}, {time.monotonic() - began:.0f} s\n{text}", flush=True)
    if failed:
        raise SystemExit(f"{failed} failed")


if __name__ == "__main__":
    main()
