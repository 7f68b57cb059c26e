"""Small demo files, made up from their numbers."""

import numpy as np

from torch_denkf.applications.ur5.data.files import Demo, write_demo, write_manifest
from torch_denkf.applications.ur5.simulation.names import TASKS

LENGTHS = (9, 12, 7, 15, 8, 11, 10, 13, 6, 14)
SIZE = (12, 16)


def make_demo(number, rows, frames=3, size=SIZE):
    rng = np.random.default_rng(number)
    return Demo(
        number,
        TASKS[number % 3],
        "sim",
        100 + number,
        rng.normal(number, 1 + number, (rows, 10)).astype(np.float32),
        rng.normal(size=(rows, 7)).astype(np.float32),
        rng.random(rows) < 0.5,
        np.sort(rng.choice(rows, frames, replace=False)).astype(np.int32),
        rng.integers(0, 256, (frames, 3, *size), np.uint8),
    )


def write_folder(folder, demos):
    write_manifest(folder, [write_demo(folder, demo) for demo in demos])
    return folder


def ten_demos(tmp_path_factory):
    """Returns a folder of ten demos of various lengths, three pictures in each."""
    demos = [make_demo(number, rows) for number, rows in enumerate(LENGTHS)]
    return write_folder(tmp_path_factory.mktemp("demos"), demos)
