"""Files of somebody with bad intentions: pickles that run code, archives that unpack to more than there is room for."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from functools import cache
from pathlib import Path

import numpy as np

__all__ = ["MARK", "Bomb", "npz_of_zeros", "ran"]

#: What a hostile file makes in the working folder when it gets to run.
MARK = "the-code-ran"


class Bomb:
    """A pickle of it makes a file when it is read."""

    def __reduce__(self):
        return (os.mkdir, (MARK,))

    @staticmethod
    def pickled() -> bytes:
        """The pickle."""
        return pickle.dumps(Bomb())

    @staticmethod
    def npz(name: str) -> bytes:
        """An archive of arrays, one of them of such objects."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=True, **{name: np.array([Bomb()], dtype=object)})
        return buffer.getvalue()


def ran(folder: Path) -> bool:
    """Whether a hostile file got to run."""
    return (folder / MARK).exists()


@cache
def npz_of_zeros(size: int) -> bytes:
    """A small archive with an array of so many bytes."""
    buffer, head = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "|u1", "fortran_order": False, "shape": (size,)})
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("pixels.npy", "w", force_zip64=True) as out,
    ):
        out.write(head.getvalue())
        for _ in range(size >> 20):
            out.write(bytes(1 << 20))
    return buffer.getvalue()
