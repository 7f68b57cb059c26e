"""File locks that end with their process, also after a kill.

The library filelock creates the lock file when checking it. The sweep of temporary folders must not: a folder without a
lock would then look as if it were in use.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["locked", "take_lock"]


def take_lock(file: Path, *, create: bool = True) -> int | None:
    """Takes the lock of a file without waiting.

    Args:
        file: the lock file.
        create: whether to create the file.

    Returns:
        A file descriptor, which releases the lock when closed; None while another process holds the lock, and without
        the file.

    Raises:
        OSError: if the file cannot be opened, or its file system has no locks.
    """
    try:
        descriptor = os.open(file, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if create else 0), 0o644)
    except FileNotFoundError:
        if create:
            raise
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(descriptor), os.stat(file)):
            return descriptor
    except (BlockingIOError, FileNotFoundError):  # another process holds it, or has just removed it
        pass
    except BaseException:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


@contextmanager
def locked(folder: Path, name: str, doing: str) -> Iterator[None]:
    """Locks a folder for this process, until the block or the process ends.

    Args:
        folder: created if it does not exist.
        name: name of the lock file, which is removed at the end.
        doing: activity of the lock's holder, for the message: ``"is writing to it"``.

    Raises:
        OSError: if another process holds the lock, or the folder cannot be written to; the message names the folder and
            the process.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with locked(folder, ".lock", "is writing to it"), locked(folder, ".lock", "is writing to it"):
        ...     pass
        Traceback (most recent call last):
        OSError: cannot use ...: another process is writing to it (process ...); wait for it to end, or choose ...
    """
    file = folder / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = take_lock(file) or take_lock(file)  # the first holder may have removed it at that moment
    except OSError as error:
        raise type(error)(error.errno, f"cannot use {folder}: {error.strerror}; choose another folder") from error
    if held is None:
        holder = ""
        with contextlib.suppress(OSError):
            holder = file.read_text().strip()
        raise OSError(
            f"cannot use {folder}: another process {doing} ({holder or 'unknown'}); wait for it to end, or choose "
            "another folder"
        )
    try:
        os.ftruncate(held, 0)
        with contextlib.suppress(OSError):  # a full disk: the lock holds without the number
            os.write(held, f"process {os.getpid()}".encode())
        yield
    finally:
        file.unlink(missing_ok=True)
        os.close(held)
