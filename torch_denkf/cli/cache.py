"""``denkf cache``: what is kept of earlier runs, whether it is sound, and how to be rid of it.

::

    denkf cache list                     # entries, sizes, ages
    denkf cache check                    # every byte against its checksum; 1 if one is damaged
    denkf cache clear --older-than 30    # entries of which nothing was written in 30 days
    denkf cache clear --damaged

Entries are decoded pictures and optical flow: all can be made again, from the recordings. From Python:

>>> import tempfile
>>> Cache.main(["list", "--folder", tempfile.mkdtemp()])
0 entries, 0.0 MB, in ...
0
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from torch_denkf.cli.command import Command, say

__all__ = ["Cache"]

_DAY = 86400.0


@dataclass
class Cache(Command):
    """List, check or clear the cache of earlier runs: decoded images and optical flow."""

    what: Positional[
        Literal["list", "check", "clear"]
    ]  # list entries, compare them with their checksums, or remove them
    folder: Path | None = None  # of the cache; $TORCH_DENKF_CACHE, or else ~/.cache/torch_denkf, by default
    damaged: bool = False  # clear: only what is damaged
    older_than: float | None = None  # clear: only what was written before so many days

    name, example = "cache", "denkf cache check"

    def run(self) -> int:
        """Goes over all entries."""
        from torch_denkf.data.cache import entries_of, forget, usual_folder
        from torch_denkf.deployment.files import sweep

        if self.what != "clear" and (self.damaged or self.older_than is not None):
            raise ValueError("--damaged and --older-than belong to denkf cache clear")
        folder = (self.folder or usual_folder()).expanduser()
        swept = sweep(folder) if folder.is_dir() else 0
        if swept:
            say(f"removed what {swept} killed processes left half written")
        entries, damaged, size = entries_of(folder), 0, 0
        for entry in entries:
            bytes_, age = _size(entry), (time.time() - entry.stat().st_mtime) / _DAY
            text = f"{bytes_ / 1e6:10.1f} MB  {age:7.1f} days  {entry.name}"
            if self.what == "list":
                say(text)
            elif self.what == "check":
                wrong = _wrong(entry)
                damaged += wrong is not None
                say(f"{text}: {wrong or 'sound'}")
            else:
                young = self.older_than is not None and age < self.older_than
                if young or (self.damaged and _wrong(entry) is None):
                    continue
                forget(entry)
                say(f"{text}: removed")
            size += bytes_
        if self.what == "clear":
            say(f"{size / 1e6:.1f} MB removed from {folder}")
            return 0
        say(f"{len(entries)} entries, {size / 1e6:.1f} MB, in {folder}")
        if damaged:
            say(f"{damaged} damaged: each is made again when it is next used, or goes with denkf cache clear --damaged")
        return 1 if damaged else 0


def _size(entry: Path) -> int:
    return sum(file.stat().st_size for file in entry.rglob("*") if file.is_file())


def _wrong(entry: Path) -> str | None:
    from torch_denkf.data.cache_entry import DamagedEntry, check_entry

    try:
        check_entry(entry)
    except (DamagedEntry, FileNotFoundError) as error:
        return str(error)
    return None
