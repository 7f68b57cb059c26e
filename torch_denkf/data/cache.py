"""Disk cache of TensorDicts that are costly to compute; they are memory-mapped when opened."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tensordict import TensorDict

from torch_denkf.data.cache_entry import DamagedEntry, is_entry, open_entry, write_entry
from torch_denkf.deployment.files import clear_errors, place_beside, sweep, sync

__all__ = ["cache_folder", "cached", "entries_of", "forget", "stamp", "usual_folder"]

_LOG = logging.getLogger("torch_denkf")


def usual_folder() -> Path:
    """Returns the default folder of the cache: ``$TORCH_DENKF_CACHE``, or ``~/.cache/torch_denkf``."""
    return Path(os.environ.get("TORCH_DENKF_CACHE") or Path.home() / ".cache" / "torch_denkf").expanduser()


def cache_folder(cache: str | Path | bool | None) -> Path | None:
    """Returns the folder of an option ``cache``: True for the default folder, None or False for none."""
    if cache is None or cache is False:
        return None
    if cache is not True and not isinstance(cache, (str, Path)):
        raise TypeError(f"cache is a folder, True, False or None; got {cache!r}")
    return usual_folder() if cache is True else Path(cache).expanduser()


def stamp(file: Path) -> tuple[int, int]:
    """Returns the time of writing in ns and the size in bytes, which identify a file; (-1, -1) without a file."""
    try:
        status = file.stat()
    except FileNotFoundError:  # the reader of the file raises
        return (-1, -1)
    return (status.st_mtime_ns, status.st_size)


def cached(entry: Path, read: Callable[[], TensorDict]) -> TensorDict:
    """Opens a cache entry; if it is missing or damaged, reads its content again and stores it.

    Args:
        entry: folder of the entry.
        read: returns the content, tensors in memory.

    Raises:
        OSError: if the cache cannot be written; names the entry and the free space.
    """
    stored = _load(entry)
    if stored is not None:
        return stored
    _check_writable(entry)  # before hours of work
    content = read()
    with _writing(entry) as folder:
        write_entry(folder, content)
    return content if (stored := _load(entry)) is None else stored  # another process may have deleted it


def entries_of(folder: Path) -> list[Path]:
    """Returns the cache entries in a folder, valid or damaged, sorted by name; skips other folders."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.is_dir() and is_entry(path))


def forget(entry: Path) -> None:
    """Removes an entry. Processes that have it open can still read it."""
    with _errors_of(entry), place_beside(entry) as aside, contextlib.suppress(FileNotFoundError):
        entry.rename(aside)


def _load(entry: Path) -> TensorDict | None:
    sweep(entry.parent)
    try:
        return open_entry(entry)
    except FileNotFoundError:
        return None
    except DamagedEntry as damage:
        _LOG.warning("the cache entry %s is damaged, and is made again: %s", entry, damage)
        _set_aside(entry)
        return None


def _set_aside(entry: Path) -> None:
    """Removes a damaged entry, unless another process has replaced it by a valid one."""
    with _errors_of(entry), place_beside(entry) as aside, contextlib.suppress(DamagedEntry, FileNotFoundError):
        entry.rename(aside)
        open_entry(aside)
        with contextlib.suppress(OSError):  # another process has written the entry again
            aside.rename(entry)


def _check_writable(entry: Path) -> None:
    with _errors_of(entry):
        entry.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(entry.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(entry.parent))


@contextmanager
def _writing(entry: Path) -> Iterator[Path]:
    """Yields a temporary folder and renames it to the entry when it is complete: an entry that exists is complete."""
    with _errors_of(entry), place_beside(entry) as beside:
        yield beside
        try:
            beside.rename(entry)
            sync(entry.parent)
        except OSError:
            if not entry.is_dir():  # otherwise another process was faster, with the same content
                raise


def _errors_of(entry: Path):
    cure = "pass cache=FOLDER or cache=None, or set TORCH_DENKF_CACHE"
    return clear_errors(entry, cure, beside=entry.parent, name=f"the cache at {entry}")
