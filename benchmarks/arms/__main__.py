"""The command line of the study: ``python -m benchmarks.arms --help``."""

from __future__ import annotations

import os
import sys

# Before anything imports mujoco: encoders need no OpenGL, and pixels none with a window.
os.environ.setdefault("MUJOCO_GL", "egl" if "pixels" in sys.argv else "disabled")

from benchmarks.arms.study import Study, run_study
from benchmarks.common.arguments import parse

if __name__ == "__main__":
    run_study(parse(Study))
