"""Removes incomplete libraries in inductor's cache, from killed compilations or a full disk.

Inductor's linker does not write them atomically: otherwise each later compilation fails with "file too short" until the
cache is deleted.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torch_denkf.compilation.lock import take_lock

__all__ = ["clear_damaged_libraries", "clear_full_cache", "free_space", "is_whole"]

_LOG = logging.getLogger("torch_denkf")
_HEADER, _64_BITS = 64, 2  # bytes of ELF's header; its class


def free_space(folder: Path) -> str:
    """Returns the free space of a folder, or of its nearest existing parent, as text.

    Example:
        >>> free_space(Path("/"))
        '... MB free'
    """
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    status = os.statvfs(folder)
    free = status.f_bavail * status.f_frsize
    return f"{free / 1e6:.1f} MB free" if free >= 1e6 else f"{free / 1e3:.0f} kB free"


def clear_damaged_libraries(cache: Path | None = None) -> list[Path]:
    """Removes incomplete libraries that no process is writing, so that they are compiled again.

    Args:
        cache: folder of inductor's cache; by default the one in use.

    Returns:
        Removed files; the log names each.
    """
    if not sys.platform.startswith("linux"):
        return []
    cache = cache or _cache_in_use()
    removed = []
    for library in cache.glob("*/*.so"):
        with contextlib.suppress(OSError):
            if not is_whole(library) and _remove(library, cache / "locks"):
                _LOG.warning("inductor's cache held half a library, %s: it is compiled again", library)
                removed.append(library)
    return removed


@contextmanager
def clear_full_cache() -> Iterator[None]:
    """Raises a clear error if a compilation fails because the disk of inductor's cache is full.

    Raises:
        OSError: the message names the cache and the free space.
    """
    try:
        yield
    except Exception as error:
        if os.strerror(errno.ENOSPC) not in str(error):
            raise
        cache = _cache_in_use()
        raise OSError(
            errno.ENOSPC,
            f"cannot compile in {cache}, inductor's cache: {os.strerror(errno.ENOSPC)}, {free_space(cache)}; free some "
            "space, or set TORCHINDUCTOR_CACHE_DIR to another folder",
        ) from error


def _cache_in_use() -> Path:
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    return Path(cache_dir())


def is_whole(library: Path) -> bool:
    """Returns True if a file is a complete library (ELF, 64 bits), by the length in its header."""
    with library.open("rb") as stream:
        header, size = stream.read(_HEADER), os.fstat(stream.fileno()).st_size
        if len(header) < _HEADER or header[:4] != b"\x7fELF":
            return False
        if header[4] != _64_BITS:
            return True
        segments, sections, segment_size, segment_count, section_size, section_count = struct.unpack_from(
            "<32xQQ6xHHHH", header
        )
        if (
            not segment_count
            or max(segments + segment_size * segment_count, sections + section_size * section_count) > size
        ):
            return False
        stream.seek(segments)
        table = stream.read(segment_size * segment_count)
    ends = (sum(struct.unpack_from("<8xQ16xQ", table, at)) for at in range(0, len(table), segment_size))
    return max(ends) <= size


def _remove(library: Path, locks: Path) -> bool:
    """Removes a library under the lock of its compilation; returns False while another process compiles it."""
    locks.mkdir(exist_ok=True)
    held = take_lock(locks / f"{library.name.split('.')[0]}.lock")
    if held is None:
        return False
    try:
        if is_whole(library):  # compiled meanwhile
            return False
        library.unlink()
        return True
    finally:
        os.close(held)
