"""The command line of the study: ``python -m benchmarks.arms --help``."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

# Before anything imports mujoco: encoders need no OpenGL, and pixels none with a window.
os.environ.setdefault("MUJOCO_GL", "egl" if "pixels" in sys.argv else "disabled")

from benchmarks.arms.arms import ARMS
from benchmarks.arms.study import Study, run_task
from benchmarks.common.arguments import parse


def main() -> None:
    """Runs a task, or with ``--smoke`` all of them."""
    study = parse(Study)
    demos, steps = study.demos or (240 if study.pixels else 100), study.steps or (120 if study.pixels else 200)
    if not study.smoke:
        run_task(replace(study, demos=demos, steps=steps, out=study.out / f"{study.task}_{study.source}"))
        return
    for task in ARMS:
        tiny = {"demos": 4, "episodes": 2, "steps": 24, "sensor_updates": 3, "updates": 4}
        run_task(replace(study, task=task, out=study.out / "smoke" / f"{task}_{study.source}", **tiny))


if __name__ == "__main__":
    main()
