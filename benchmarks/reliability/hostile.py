"""Files of somebody with bad intentions: pickles that run code, archives that unpack to more than there is room for."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

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


def _saved(content: Any) -> Callable[[Path], None]:
    return lambda file: torch.save(content, file)


def _zip(file: Path) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("readme.txt", "hello")


def _pickle_in_zip(file: Path) -> None:
    """Torch's layout, with a pickle of somebody else's."""
    buffer = io.BytesIO()
    torch.save({"format": "torch_denkf.training/1"}, buffer)
    with zipfile.ZipFile(buffer) as archive, zipfile.ZipFile(file, "w") as out:
        for name in archive.namelist():
            out.writestr(name, Bomb.pickled() if name.endswith("data.pkl") else archive.read(name))


#: What writes a file in the place of weights.
PICKLES: dict[str, Callable[[Path], Any]] = {
    "a pickle": lambda file: file.write_bytes(Bomb.pickled()),
    "torch's pickle of code": _saved(Bomb()),
    "torch's pickle of code, nested": _saved({"format": "torch_denkf.training/1", "model": {"a": Bomb()}}),
    "a pickle in torch's archive": _pickle_in_zip,
    "another archive": _zip,
    "an archive that unpacks to a gigabyte": lambda file: file.write_bytes(npz_of_zeros(1 << 30)),
    "a whole module": _saved(torch.nn.Linear(2, 2)),
    "a list": _saved([1, 2]),
    "a dictionary of others": _saved({"weights": torch.ones(2)}),
    "a later format": _saved({"format": "torch_denkf.training/9"}),
}
