"""Results on disk: written whole or not at all, and a clear word where the disk is full."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from torch_denkf._lock import take_lock

__all__ = ["clear_errors", "free_space", "replacing", "reserve", "sync", "write_bytes", "write_text"]

_PART = re.compile(r"\..+\.[0-9a-f]{8}\.part(\.[^.]*)?")  # .NAME.TOKEN.part.SUFFIX
_BLOCK = 1 << 24
#: Errors of the disk, not of the path.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def free_space(folder: Path) -> str:
    """How much a user may still write to a folder, or to the nearest one above that is there.

    Example:
        >>> free_space(Path("/"))
        '... MB free'
    """
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    status = os.statvfs(folder)
    free = status.f_bavail * status.f_frsize
    return f"{free / 1e6:.1f} MB free" if free >= 1e6 else f"{free / 1e3:.0f} kB free"


@contextmanager
def clear_errors(
    file: Path, cure: str = "choose another folder", *, beside: Path | None = None, name: str = ""
) -> Iterator[None]:
    """Errors of writing to a file or folder say its name, the free space, and what to do.

    Args:
        file: what is written.
        cure: what to do if not only space is missing.
        beside: where it is written to until it is complete.
        name: of what is written, for the message; by default the file.

    Raises:
        OSError: of the same kind and number, with the message.
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


def _holds(folder: str, file: Path) -> bool:
    return any(str(parent) == folder for parent in file.parents)


@contextmanager
def replacing(file: str | Path) -> Iterator[Path]:
    """A path to write to, whose file takes the place of ``file`` when the block ends, synced with the disk.

    Where the block or the disk fails, an earlier ``file`` stays as it was, and nothing else is left. What a killed
    process left in the folder goes when the next file is written there.

    Args:
        file: result; its folder is made. What is no plain file, such as ``/dev/stdout``, is written to directly.

    Yields:
        A path in the same folder, with the same suffix, of an empty file.

    Raises:
        OSError: if the file cannot be written; names it and the free space.

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
    file = Path(os.path.realpath(Path(file).expanduser()))  # a link stays one
    if file.exists() and not file.is_file() and not file.is_dir():
        with clear_errors(file):
            yield file
        return
    with clear_errors(file):
        if file.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(file))
        file.parent.mkdir(parents=True, exist_ok=True)
        _sweep(file.parent)
    beside, held = _claim(file)
    with clear_errors(file, beside=beside):
        try:
            yield beside
            sync(beside)  # else a power failure could put an empty file in the place of a good one
            os.replace(beside, file)
            sync(file.parent)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise
        finally:
            if held is not None:
                os.close(held)


def write_bytes(file: str | Path, data: bytes | bytearray | memoryview) -> None:
    """Writes a file whole or not at all; see :func:`replacing`."""
    with replacing(file) as beside, beside.open("wb") as stream:
        stream.write(data)


def write_text(file: str | Path, text: str) -> None:
    """Writes a text in UTF-8 whole or not at all; see :func:`replacing`."""
    write_bytes(file, text.encode())


def reserve(stream: IO[bytes], size: int) -> None:
    """Gives a new file its size, with the space for it on the disk: what is then written through a map has its place.

    Without that, a disk that is full ends the process (SIGBUS).

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
    """Waits until a file, or what names the files of a folder, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems do not sync folders
            raise
    finally:
        os.close(descriptor)


def _claim(file: Path) -> tuple[Path, int | None]:
    """A new file beside ``file``, and its lock: who sweeps sees that it is in use."""
    while True:
        token = uuid.uuid4().hex[:8]
        beside = file.with_name(f".{file.name[:100]}.{token}.part{file.suffix}")
        with clear_errors(file, beside=beside):
            os.close(os.open(beside, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            try:
                held = take_lock(beside, create=False)
            except OSError:  # no locks here: nobody sweeps, either
                return beside, None
            if held is not None:
                return beside, held


def _sweep(folder: Path) -> None:
    """Removes what killed processes left half written."""
    for name in os.listdir(folder):
        if _PART.fullmatch(name):
            with contextlib.suppress(OSError):
                held = take_lock(folder / name, create=False)
                if held is not None:
                    (folder / name).unlink(missing_ok=True)
                    os.close(held)
