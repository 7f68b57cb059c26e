"""Malicious files: pickles that run code, and archives that unpack to more than the available memory."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

#: Folder that a hostile file makes in the working folder if its code runs.
MARK = "the-code-ran"


class Bomb:
    """An object whose pickle makes the folder ``MARK`` when it is loaded."""

    def __reduce__(self):
        return (os.mkdir, (MARK,))

    @staticmethod
    def pickled() -> bytes:
        """Returns the pickle."""
        return pickle.dumps(Bomb())

    @staticmethod
    def npz(name: str) -> bytes:
        """Returns an archive with an object array that has such an object."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=True, **{name: np.array([Bomb()], dtype=object)})
        return buffer.getvalue()


@cache
def npz_of_zeros(size: int) -> bytes:
    """Returns a small archive with an array of ``size`` bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, pixels=np.zeros(size, np.uint8))
    return buffer.getvalue()


def archive(members: Mapping[str, str | bytes]) -> Callable[[Path], None]:
    """Returns a function that writes an archive with these members."""

    def write(file: Path) -> None:
        with zipfile.ZipFile(file, "w") as out:
            for name, content in members.items():
                out.writestr(name, content)

    return write


def members_of(file: Path | io.BytesIO) -> dict[str, bytes]:
    """Returns the members of an archive."""
    with zipfile.ZipFile(file) as stored:
        return {name: stored.read(name) for name in stored.namelist()}


def _saved(content: Any) -> Callable[[Path], None]:
    return lambda file: torch.save(content, file)


def _pickle_in_zip(file: Path) -> None:
    """Writes a checkpoint in torch's layout with a malicious pickle."""
    torch.save({"format": "torch_denkf.training/1"}, buffer := io.BytesIO())
    members = members_of(buffer)
    archive(members | {name: Bomb.pickled() for name in members if name.endswith("data.pkl")})(file)


#: Payload that writes a file, saved as weights.
PICKLES: dict[str, Callable[[Path], Any]] = {
    "a pickle": lambda file: file.write_bytes(Bomb.pickled()),
    "torch's pickle of code": _saved(Bomb()),
    "torch's pickle of code, nested": _saved({"format": "torch_denkf.training/1", "model": {"a": Bomb()}}),
    "a pickle in torch's archive": _pickle_in_zip,
    "another archive": archive({"readme.txt": "hello"}),
    "an archive that unpacks to a gigabyte": lambda file: file.write_bytes(npz_of_zeros(1 << 30)),
    "a whole module": _saved(torch.nn.Linear(2, 2)),
    "a list": _saved([1, 2]),
    "a dictionary of others": _saved({"weights": torch.ones(2)}),
    "a later format": _saved({"format": "torch_denkf.training/9"}),
}
