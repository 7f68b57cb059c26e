"""Memory-mapped cache of a collection of demos at one resolution."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.applications.ur5.data.files import COMMAND, MANIFEST, Demo, Entry, read_demo, read_manifest
from torch_denkf.applications.ur5.simulation.names import TASKS
from torch_denkf.data.cache import cache_folder, cached
from torch_denkf.data.pictures import check_size, image_store, scaled

_FORMAT = 1  # part of the cache's key: raise it when what is stored changes
_CHUNK = 8  # demos that are decoded ahead of what is written


def read_entries(root: Path) -> list[Entry]:
    """Returns the manifest of a folder of demos.

    Raises:
        FileNotFoundError: without the folder, or without a demo in it.
        ValueError: if the manifest is damaged, with the line.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root}; collect demos into it: {COMMAND} --out {root}")
    entries = list(read_manifest(root).values())
    if not entries:
        raise FileNotFoundError(f"no demos in {root}: no {MANIFEST}, or an empty one; {COMMAND} --out {root} writes it")
    return entries


def read_demos(
    root: Path,
    entries: Sequence[Entry],
    size: tuple[int, int] | None,
    cache: str | Path | bool | None,
    progress: Callable[[int], object],
) -> TensorDict:
    """Loads consecutive demos, from the cache or from their files, with verified checksums.

    ======================= ========== ==========================================================================
    key                     shape      content
    ======================= ========== ==========================================================================
    ``rows``/``state``      [R,10]     float32
    ``rows``/``action``     [R,7]      float32
    ``rows``/``success``    [R,1]      bool
    ``rows``/``task``       [R,1]      int64, a number in ``TASKS``
    ``rows``/``step``       [R,1]      int64, from 0 in each demo
    ``rows``/``frame``      [R,1]      int64: index of its image in ``frames``, or -1
    ``frames``/``pixels``   [F,3,H,W]  uint8
    ``frames``/``sum``      [F,3]      int64, over a frame's pixels
    ``frames``/``square``   [F,3]      int64, of squares, likewise
    ======================= ========== ==========================================================================

    Without images there are no ``frames``.

    Args:
        root: folder of the demos.
        entries: the demos to read.
        size: (H, W) of the images after scaling; None for no scaling.
        cache: folder of the cache; True for the default, None or False for none, with all in memory.
        progress: called with the number of demos read since the last call.

    Raises:
        FileNotFoundError: if a demo's file is missing.
        ValueError: if a file was changed, is no demo, or differs in size from the first; or if ``size`` is larger.
        OSError: if the cache cannot be written.
    """
    size = None if size is None else check_size(size)
    directory = cache_folder(cache)
    if directory is None:
        return _read(root, entries, size, None, progress)
    key = json.dumps([_FORMAT, size, [astuple(entry) for entry in entries]])  # by content, wherever the folder lies
    name = "x".join(map(str, size)) if size else "stored"
    entry = directory / f"ur5-{len(entries)}-{name}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"
    return cached(entry, lambda: _read(root, entries, size, directory, progress))


def _read(
    root: Path,
    entries: Sequence[Entry],
    size: tuple[int, int] | None,
    folder: Path | None,
    progress: Callable[[int], object],
) -> TensorDict:
    native = read_demo(root, entries[0]).pixels.shape[2:]
    height, width = native if size is None else size
    frames = sum(entry.frames for entry in entries)
    if frames and (height > native[0] or width > native[1]):
        raise ValueError(f"size {size} is larger than the demos' {native} in {root}; collect larger ones or pass less")
    # Pictures go to the disk: those of whole sequences of 2,000 demos at 112 px are 26 GB.
    pixels = image_store(frames, (height, width), folder if frames else None)
    sums, parts, shot = np.zeros((2, frames, 3), np.int64), [], 0

    def read(entry: Entry) -> tuple[Demo, list[np.ndarray]]:
        demo = read_demo(root, entry)
        if demo.pixels.shape[2:] != native:
            raise ValueError(
                f"{root / entry.file} has pictures of (H, W) = {demo.pixels.shape[2:]}, but "
                f"{root / entries[0].file} of {native}; the demos of a folder have one size: collect into another"
            )
        return demo, [scaled(picture.transpose(1, 2, 0), (height, width)) for picture in demo.pixels]

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # zlib, SHA-256 and OpenCV work without the GIL
        for begin in range(0, len(entries), _CHUNK):
            for demo, pictures in pool.map(read, entries[begin : begin + _CHUNK]):
                parts.append(_rows(demo, shot))
                for picture in pictures:
                    pixels[shot] = picture
                    sums[:, shot] = (
                        picture.sum((1, 2), np.int64),
                        np.square(picture, dtype=np.uint16).sum((1, 2), np.int64),
                    )
                    shot += 1
                progress(1)
    rows = {key: torch.from_numpy(np.concatenate([part[key] for part in parts])) for key in parts[0]}
    store = {"rows": TensorDict(rows, [len(rows["step"])])}
    if frames:
        taken = {"pixels": pixels, "sum": sums[0], "square": sums[1]}
        store["frames"] = TensorDict({key: torch.from_numpy(value) for key, value in taken.items()}, [frames])
    return TensorDict(store)


def _rows(demo: Demo, shot: int) -> dict[str, np.ndarray]:
    """Returns the rows of a demo whose first image has the index ``shot``."""
    count = len(demo.state)
    frame = np.full(count, -1)
    frame[demo.steps] = np.arange(shot, shot + len(demo.steps))
    return {
        "state": demo.state.astype(np.float32),
        "action": demo.action.astype(np.float32),
        "success": demo.success[:, None],
        "task": np.full((count, 1), TASKS.index(demo.task)),
        "step": np.arange(count)[:, None],
        "frame": frame[:, None],
    }
