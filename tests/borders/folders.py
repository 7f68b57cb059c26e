"""Makes sound folders once, with what all borders of files share."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import apart, workshop

ALL_ROWS = {"split": "all", "cache": None, "progress": False}
SIZES = d.SIZE | d.of((1.5, 2.5))


def made(name: str, write: Callable[[Path], Any]) -> Callable[[], Path]:
    """Returns what makes a folder, once, in a process of its own: OpenCV's threads are not to be forked."""

    @cache
    def make() -> Path:
        root = workshop() / name
        root.mkdir()
        apart(lambda: write(root))
        return root

    return make


def one_row(place: tuple[Any, ...]) -> bool:
    """Tells whether a place is a whole row: without it, the others are sound."""
    return len(place) == 1


def bomb(data: bytes) -> bytes:
    """Returns a picture that says that it is of 60,000 x 60,000 pixels."""
    return data[:16] + struct.pack(">II", 60000, 60000) + data[24:]


def picture(size: tuple[int, int], suffix: str) -> d.Change:
    """Writes a grey picture in a file's place."""
    return lambda file: file.write_bytes(cv2.imencode(suffix, np.full((*size, 3), 7, np.uint8))[1].tobytes())
