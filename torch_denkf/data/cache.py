"""Memory-mapped TensorDicts that were costly to make, kept on disk from one run to the next."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from tensordict import TensorDict


def _cache_directory() -> Path:
    return Path(os.environ.get("TORCH_DENKF_CACHE") or Path.home() / ".cache" / "torch_denkf").expanduser()


def cache_folder(cache: str | Path | bool | None) -> Path | None:
    """The folder that an option ``cache`` asks for: True for the usual one, None or False for none."""
    if cache is None or cache is False:
        return None
    return _cache_directory() if cache is True else Path(cache).expanduser()


def stamp(file: Path) -> tuple[int, int]:
    """Time in ns and size in bytes of a file, by which a cache knows it again; (-1, -1) where there is none."""
    try:
        status = file.stat()
    except FileNotFoundError:  # its reader says what is missing
        return (-1, -1)
    return (status.st_mtime_ns, status.st_size)


def _cached(entry: Path, read: Callable[[], TensorDict]) -> TensorDict:
    """Load a cache entry, or read it into memory and store it."""
    stored = _load(entry)
    return _store(entry, read().memmap) if stored is None else stored


def _cached_in_place(entry: Path, write: Callable[[Path], object]) -> TensorDict:
    """Load a cache entry, or have it written into the folder that is passed, for what is too large for memory.

    Raises:
        OSError: if the cache cannot be written.
    """
    stored = _load(entry)
    return _store(entry, write) if stored is None else stored


def _load(entry: Path) -> TensorDict | None:
    if entry.is_dir():
        try:
            return TensorDict.load_memmap(entry)
        except (OSError, RuntimeError, KeyError, ValueError):  # damaged from outside: make it anew
            shutil.rmtree(entry, ignore_errors=True)
    return None


def _store(entry: Path, write: Callable[[Path], object]) -> TensorDict:
    """Write an entry beside its place and rename it, so that one that exists is complete."""
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(prefix=".writing-", dir=entry.parent))
    except OSError as error:
        raise OSError(
            f"cannot write the cache at {entry.parent} ({error}); pass cache=FOLDER or cache=None, or set "
            "TORCH_DENKF_CACHE"
        ) from error
    try:
        write(beside / "entry")
        if not entry.is_dir():
            try:
                (beside / "entry").rename(entry)
            except OSError:
                if not entry.is_dir():  # otherwise another process was faster, with the same content
                    raise
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return TensorDict.load_memmap(entry)
