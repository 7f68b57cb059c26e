"""A whole collection of demos at one resolution: decoded once, then memory-mapped."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple
from itertools import accumulate
from pathlib import Path

import cv2
import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.applications.ur5.data.files import COMMAND, MANIFEST, Demo, Entry, read_demo, read_manifest
from torch_denkf.applications.ur5.simulation.names import TASKS
from torch_denkf.data.cache import cache_folder, cached_in_place
from torch_denkf.data.pictures import check_size

_FORMAT = 1  # part of the cache's key: raise it when what is stored changes
_CHUNK = 8  # demos that are decoded ahead of what is written


def read_entries(root: Path) -> list[Entry]:
    """The manifest of a folder of demos.

    Raises:
        FileNotFoundError: without the folder, or without a demo in it.
        ValueError: naming the line, for a manifest that is damaged.
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
    """Demos one behind the other, from the cache or from their files, whose checksums are compared.

    ======================= ========== ==========================================================================
    key                     shape      content
    ======================= ========== ==========================================================================
    ``rows``/``state``      [R,10]     float32
    ``rows``/``action``     [R,7]      float32
    ``rows``/``success``    [R,1]      bool
    ``rows``/``task``       [R,1]      int64, a number in ``TASKS``
    ``rows``/``step``       [R,1]      int64, from 0 in each demo
    ``rows``/``frame``      [R,1]      int64: where its picture is in ``frames``, or -1
    ``frames``/``pixels``   [F,3,H,W]  uint8
    ``frames``/``sum``      [F,3]      int64, over a frame's pixels
    ``frames``/``square``   [F,3]      int64, of squares, likewise
    ======================= ========== ==========================================================================

    Without any pictures there are no ``frames``.

    Args:
        root: folder of the demos.
        entries: the demos to read.
        size: (H, W) to scale the pictures to; None leaves them as they are.
        cache: folder of the cache; True for the usual one, None or False for none: then all is in memory.
        progress: called with the number of demos that were read since the last call.

    Raises:
        FileNotFoundError: if a demo's file is missing.
        ValueError: if one was changed, is no demo, or is of another size than the first; or if ``size`` is larger.
        OSError: if the cache cannot be written.
    """
    size = None if size is None else check_size(size)
    directory = cache_folder(cache)
    if directory is None:
        return _read(root, entries, size, TensorDict.clone, progress)
    key = json.dumps([_FORMAT, size, [astuple(entry) for entry in entries]])  # by content, wherever the folder lies
    name = "x".join(map(str, size)) if size else "stored"
    entry = directory / f"ur5-{len(entries)}-{name}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"
    # Filled where it lies: whole sequences of 2,000 demos at 112 px are 26 GB.
    return cached_in_place(entry, lambda allocate: _read(root, entries, size, allocate, progress))


def _read(
    root: Path,
    entries: Sequence[Entry],
    size: tuple[int, int] | None,
    allocate: Callable[[TensorDict], TensorDict],
    progress: Callable[[int], object],
) -> TensorDict:
    first = read_demo(root, entries[0])
    native = first.pixels.shape[2:]
    height, width = native if size is None else size
    size = (height, width)
    frames = sum(entry.frames for entry in entries)
    if frames and (size[0] > native[0] or size[1] > native[1]):
        raise ValueError(f"size {size} is larger than the demos' {native} in {root}; collect larger ones or pass less")
    store = allocate(_like(sum(entry.rows for entry in entries), frames, size))
    starts = list(accumulate((entry.rows for entry in entries), initial=0))
    shots = list(accumulate((entry.frames for entry in entries), initial=0))

    def read(entry: Entry) -> tuple[Demo, np.ndarray]:
        demo = read_demo(root, entry)
        if demo.pixels.shape[2:] != native:
            raise ValueError(
                f"{root / entry.file} has pictures of (H, W) = {demo.pixels.shape[2:]}, but "
                f"{root / entries[0].file} of {native}; the demos of a folder have one size: collect into another"
            )
        return demo, _scale(demo.pixels, size)

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # zlib, SHA-256 and OpenCV work without the GIL
        for begin in range(0, len(entries), _CHUNK):
            for k, (demo, pixels) in enumerate(pool.map(read, entries[begin : begin + _CHUNK]), begin):
                _fill(store, demo, pixels, starts[k], shots[k])
                progress(1)
    return store


def _like(rows: int, frames: int, size: tuple[int, int]) -> TensorDict:
    """Shapes and dtypes; takes no memory."""

    def of(count: int, dtype: torch.dtype, *shape: int) -> torch.Tensor:
        return torch.zeros((), dtype=dtype).expand(count, *shape)

    entries = {
        "state": of(rows, torch.float32, 10),
        "action": of(rows, torch.float32, 7),
        "success": of(rows, torch.bool, 1),
        **{key: of(rows, torch.int64, 1) for key in ("task", "step", "frame")},
    }
    like = TensorDict({"rows": TensorDict(entries, [rows])})
    if frames:
        pictures = {"pixels": of(frames, torch.uint8, 3, *size)}
        pictures |= {key: of(frames, torch.int64, 3) for key in ("sum", "square")}
        like["frames"] = TensorDict(pictures, [frames])
    return like


def _fill(store: TensorDict, demo: Demo, pixels: np.ndarray, start: int, shot: int) -> None:
    count = len(demo.state)
    rows = store["rows"]
    frame = np.full(count, -1)
    frame[demo.steps] = np.arange(shot, shot + len(demo.steps))
    values = {"state": demo.state, "action": demo.action, "success": demo.success[:, None]}
    values |= {"task": np.full((count, 1), TASKS.index(demo.task)), "step": np.arange(count)[:, None]}
    for key, value in {**values, "frame": frame[:, None]}.items():
        rows[key][start : start + count] = torch.from_numpy(value)
    if len(pixels):
        frames = store["frames"]
        at = slice(shot, shot + len(pixels))
        frames["pixels"][at] = torch.from_numpy(pixels)
        frames["sum"][at] = torch.from_numpy(pixels.sum((2, 3), dtype=np.int64))
        frames["square"][at] = torch.from_numpy(np.square(pixels, dtype=np.uint16).sum((2, 3), dtype=np.int64))


def _scale(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if pixels.shape[2:] == size or not len(pixels):
        return pixels
    scaled = [
        cv2.resize(np.ascontiguousarray(picture.transpose(1, 2, 0)), size[::-1], interpolation=cv2.INTER_AREA)
        for picture in pixels
    ]
    return np.stack(scaled).transpose(0, 3, 1, 2)
