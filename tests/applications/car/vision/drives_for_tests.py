"""Rendered drives, read once for all tests of image motion."""

from __future__ import annotations

import tempfile
from functools import lru_cache

from torch_denkf.applications.car import read_kitti_drive, with_motion, write_drives


@lru_cache
def rendered(name: str, frames: int = 60, colour: bool = False):
    """Returns a level drive of 50 x 150 pixels; ``name`` makes the road. Clone it before changing it."""
    with tempfile.TemporaryDirectory() as folder:
        write_drives(folder, [name], frames=frames)
        return read_kitti_drive(folder, name, colour=colour, cache=None)


@lru_cache
def rendered_motion(name: str, frames: int = 60):
    """Returns its flow and road correlation, without the first row, which has none."""
    drive = with_motion(rendered(name, frames), cache=None, keep_images=False)
    return drive[1:].select("flow", "road", "state")
