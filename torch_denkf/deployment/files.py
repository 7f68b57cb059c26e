"""Atomic writes of result files, and clear errors on a full disk."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from torch_denkf.compilation.libraries import free_space
from torch_denkf.compilation.lock import take_lock

__all__ = [
    "clear_errors",
    "name_for_c",
    "place_beside",
    "replacing",
    "reserve",
    "sweep",
    "sync",
    "write_bytes",
    "write_text",
]

_WRITING, _LOCK = ".writing-", "lock"
_UNLOCKED = 3600.0  # s without a change, after which an incomplete folder without a lock belongs to a dead process
_BLOCK = 1 << 24
#: Errors of the disk, not of the path.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


@contextmanager
def clear_errors(
    file: Path, cure: str = "choose another folder", *, beside: Path | None = None, name: str = ""
) -> Iterator[None]:
    """Rewrites errors of writing to a file or folder: with its name, the free space, and what to do.

    Args:
        file: the file or folder.
        cure: what to do apart from freeing space.
        beside: temporary path until it is complete.
        name: name for the message; by default the file.

    Raises:
        OSError: the same kind and number, with the message.
    """
    try:
        yield
    except OSError as error:
        where = str(error.filename)
        ours = error.filename is None or where.startswith((str(file), str(beside or file))) or _holds(where, file)
        if error.errno in _FULL and ours:
            text = f"{os.strerror(error.errno)}, {free_space(file.parent)} in {file.parent}; free some space or {cure}"
        elif error.filename is not None and ours:
            text = f"{error.strerror} ({error.filename}); {cure}"
        else:
            raise
        raise type(error)(error.errno, f"cannot write {name or file}: {text}") from error


def name_for_c(file: str | Path) -> str:
    """Returns a path for a C library that needs UTF-8, such as OpenCV, which crashes on other names.

    Raises:
        ValueError: if it is no UTF-8; the message shows its bytes.

    Examples:
        >>> name_for_c(Path("run1.mp4"))
        'run1.mp4'
    """
    try:
        str(file).encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"the name {os.fsencode(file)!r} is no UTF-8; rename it, such as to run1.mp4") from error
    return str(file)


def _holds(folder: str, file: Path) -> bool:
    return any(str(parent) == folder for parent in file.parents)


@contextmanager
def replacing(file: str | Path) -> Iterator[Path]:
    """Yields a path whose file replaces ``file`` when the block ends, synced with the disk.

    If the block or the disk fails, an existing ``file`` is unchanged, and no other file is left. Temporary files of
    killed processes are removed with the next write to the folder.

    Args:
        file: result; its folder is created. A device, such as ``/dev/stdout``, is written to directly.

    Yields:
        The path of an empty file of the same name, in a folder next to it.

    Raises:
        OSError: if the file cannot be written; the message names it and the free space.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "table.csv"
        >>> write_text(file, "earlier")
        >>> with replacing(file) as beside:
        ...     _ = beside.write_text("half of it")
        ...     raise ValueError("no more rows")
        Traceback (most recent call last):
        ValueError: no more rows
        >>> file.read_text(), len(list(file.parent.iterdir()))
        ('earlier', 1)
    """
    file = Path(os.path.realpath(Path(file).expanduser()))  # keeps symbolic links
    if file.exists() and not file.is_file() and not file.is_dir():
        with clear_errors(file):
            yield file
        return
    with clear_errors(file):
        if file.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(file))
        file.parent.mkdir(parents=True, exist_ok=True)
    with clear_errors(file, beside=file.parent / _WRITING), place_beside(file) as beside:
        beside.touch()
        yield beside
        sync(beside)  # else a power failure could replace a good file by an empty one
        os.replace(beside, file)
        sync(file.parent)


def write_bytes(file: str | Path, data: bytes | bytearray | memoryview) -> None:
    """Writes a file atomically; see :func:`replacing`."""
    with replacing(file) as beside, beside.open("wb") as stream:
        stream.write(data)


def write_text(file: str | Path, text: str) -> None:
    """Writes a text in UTF-8 atomically; see :func:`replacing`."""
    write_bytes(file, text.encode())


def reserve(stream: IO[bytes], size: int) -> None:
    """Allocates a new file's space on the disk, for writing through a memory map.

    Otherwise a full disk ends the process (SIGBUS).

    Raises:
        OSError: if there is not enough space.
    """
    if not size:
        return
    try:
        os.posix_fallocate(stream.fileno(), 0, size)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
            raise
        for begin in range(0, size, _BLOCK):
            stream.write(bytes(min(_BLOCK, size - begin)))
        stream.flush()
        os.fsync(stream.fileno())
        stream.seek(0)


def sync(path: Path) -> None:
    """Waits until a file, or the entries of a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems do not sync folders
            raise
    finally:
        os.close(descriptor)


@contextmanager
def place_beside(target: Path) -> Iterator[Path]:
    """Yields a path of the target's name in a temporary folder next to it, on the same disk.

    The folder is removed at the end, or swept after this process was killed.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "drive"
        >>> with place_beside(target) as beside:
        ...     beside.mkdir()
        ...     _ = beside.rename(target)
        >>> [path.name for path in target.parent.iterdir()]
        ['drive']
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    sweep(target.parent)
    folder, held = _claim(target.parent)
    try:
        yield folder / target.name
    finally:
        _remove(folder, held)


def sweep(folder: Path) -> int:
    """Removes incomplete files of killed processes next to the files and folders in a folder.

    Returns:
        Number of removed folders.
    """
    swept = 0
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):
            if name.startswith(_WRITING):
                with contextlib.suppress(OSError):
                    swept += _sweep(folder / name)
    return swept


def _sweep(left: Path) -> bool:
    """Removes a temporary folder whose process has ended."""
    with contextlib.suppress(OSError):
        left.rmdir()  # an empty one, of a process that was killed at the beginning or the end
        return True
    held, locks = None, (left / _LOCK).exists()
    try:
        held = take_lock(left / _LOCK, create=False)
    except OSError:
        locks = False
    if held is None and (
        locks or time.time() - max(path.stat().st_mtime for path in (left, *left.rglob("*"))) < _UNLOCKED
    ):
        return False
    _remove(left, held)
    return True


def _remove(left: Path, held: int | None) -> None:
    """Removes a temporary folder, its lock last, so that leftovers after a kill can be recognised."""
    with contextlib.suppress(OSError):
        for path in left.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != _LOCK:
                path.unlink(missing_ok=True)
    shutil.rmtree(left, ignore_errors=True)
    if held is not None:
        os.close(held)


def _claim(parent: Path) -> tuple[Path, int | None]:
    """Creates a temporary folder and its lock; None on a file system without locks."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=_WRITING, dir=parent))
        try:
            held = take_lock(folder / _LOCK)
        except FileNotFoundError:  # swept while it was empty
            continue
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                shutil.rmtree(folder, ignore_errors=True)
                raise
            return folder, None
        if held is not None:
            return folder, held
