"""Robot recordings: episodes of camera images with joint states, one row per frame."""

from __future__ import annotations

import hashlib
import json
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.data.cache import cache_folder, cached, stamp
from torch_denkf.data.lerobot.files import (
    EpisodeFiles,
    Layout,
    check_empty,
    check_files,
    decode_image,
    read_layout,
    read_table,
    rows_of_episode,
    vectors,
)
from torch_denkf.data.lerobot.masking import mask_invalid_rows, repaired_times
from torch_denkf.data.pictures import image_store, scaled, text_of_size
from torch_denkf.data.video import frames_at_times
from torch_denkf.deployment.progress import progress_bar
from torch_denkf.diagnosis.logs import in_origin, look_at_numbers, warn_of_log

_FORMAT = 2  # part of the cache's key: raise it when the stored content changes


@dataclass(frozen=True)
class DecodedRecording:
    """Decoded data set that :class:`torch_denkf.data.LeRobotReplay` replays.

    Attributes:
        rows: batch size ``[N]``, the rows of each episode in order of time: ``image`` uint8 ``[N,3,H,W]``, zeros where
            it is missing, ``observed`` bool ``[N,1]``, ``state`` float32 ``[N,S]``, maybe ``action`` float32 ``[N,A]``,
            ``time`` float64 ``[N,1]`` s, ``frame`` int64 ``[N,1]``, counted from 0 in each episode, and ``episode``
            int64 ``[N]``. If a state or action is not finite, also the masks of
            :func:`~torch_denkf.data.lerobot.masking.mask_invalid_rows`.
        fps: rows per second.
        names: names of the state's components, if known.
        source: folder of the recording, if there is one.
    """

    rows: TensorDict
    fps: float
    names: tuple[str, ...] | None = None
    source: Path | None = None


def read_recording(
    root: Path,
    *,
    camera: str | None,
    state_key: str,
    action_key: str | None,
    size: tuple[int, int],
    cache: str | Path | bool | None,
    progress: bool,
    episodes: Sequence[int] | None = None,
    origin: Mapping[str, Any] | None = None,
) -> DecodedRecording:
    """Reads episodes of a LeRobot folder, or loads them from the cache.

    Raises:
        ImportError: without pyarrow.
        FileNotFoundError: without the folder or one of its files.
        ValueError: for unknown features and cameras, and for damaged or contradictory files.
    """
    layout = read_layout(root, camera, episodes)
    if action_key == "action" and action_key not in layout.features:  # the default: actions are optional
        action_key = None
        numbers = [key for key, one in layout.features.items() if one["dtype"] not in ("image", "video", "string")]
        look_for_actions(numbers, layout.meta[0])
    keys = {"state": state_key} if action_key is None else {"state": state_key, "action": action_key}
    widths = {name: layout.width(key) for name, key in keys.items()}
    names = layout.names(state_key)
    if unknown := [name for name in origin or {} if name not in keys]:
        raise ValueError(f"origin names {unknown}; it holds numbers for {list(keys)}")
    origins = {
        name: (-in_origin(np.zeros((1, widths[name])), given, f"origin of {name!r}"))[0].tolist()
        for name, given in (origin or {}).items()
    }
    folder = cache_folder(cache)
    if folder is None:
        return DecodedRecording(_read(layout, keys, widths, size, None, progress, origins), layout.fps, names, root)
    key = [
        _FORMAT,
        str(root),
        layout.camera,
        keys,
        layout.fps,
        *size,
        origins,
        [episode.number for episode in layout.episodes],
    ]
    key += [(str(file.relative_to(root)), *stamp(file)) for file in _files(layout)]
    digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]
    entry = folder / f"lerobot-{root.name}-{layout.camera}-{size[0]}x{size[1]}-{digest}"
    rows = cached(entry, lambda: _read(layout, keys, widths, size, folder, progress, origins))
    return DecodedRecording(rows, layout.fps, names, root)


def look_for_actions(keys: Iterable[str], place: object) -> None:
    """Warns of entries that are named like actions, but are not read."""
    close = [key for key in keys if re.search("action|command|cmd", key, re.IGNORECASE)]
    if close:
        warn_of_log(
            place,
            close[0],
            "is left out, and looks like the commands" + (f", as do {close[1:]}" if close[1:] else ""),
            f"pass action_key={close[0]!r}, or action_key=None for none",
        )


def _files(layout: Layout) -> list[Path]:
    files = {*layout.meta, *(e.data for e in layout.episodes), *(e.video for e in layout.episodes if e.video)}
    if layout.episodes[0].video is None:
        files |= set((layout.root / "images" / layout.camera).rglob("*.png"))
    return sorted(files)


class _Frames:
    """The images of all rows, filled one by one."""

    def __init__(self, rows: int, size: tuple[int, int], folder: Path | None, progress: bool):
        self.size, self.observed = size, np.zeros((rows, 1), bool)
        self._native: tuple[tuple[int, ...], object] | None = None
        self.images = image_store(rows, size, folder)
        self._bar = progress_bar("reading recordings", rows, unit=" frames", shown=progress)

    def put(self, rows: np.ndarray, image: np.ndarray, source: object) -> None:
        """Scales an image and stores it in ``rows``."""
        if self._native is None:
            self._native = image.shape[:2], source
        if image.shape[:2] != self._native[0]:
            raise ValueError(
                f"{source} is {text_of_size(image.shape)}, but {self._native[1]} is {text_of_size(self._native[0])}; "
                "one camera has images of one size"
            )
        self.images[rows] = scaled(image, self.size)
        self._bar.update(int((~self.observed[rows]).sum()))
        self.observed[rows] = True

    def close(self) -> None:
        self._bar.close()


def _read(
    layout: Layout,
    keys: dict[str, str],
    widths: dict[str, int],
    size: tuple[int, int],
    folder: Path | None,
    progress: bool,
    origin: Mapping[str, Sequence[float]],
) -> TensorDict:
    check_files(layout)
    check_empty(layout)
    lengths = [episode.length for episode in layout.episodes]
    starts = np.cumsum([0, *lengths])
    numbers = {name: np.empty((starts[-1], width), np.float32) for name, width in widths.items()}
    time, stamped = np.empty(starts[-1]), np.ones(starts[-1], bool)
    frames = _Frames(starts[-1], size, folder, progress)
    videos: dict[Path, list[int]] = {}
    opened, table, swallowed = None, None, set[str]()
    try:
        for place, episode in enumerate(layout.episodes):
            if episode.data != opened:
                opened, table = episode.data, read_table(episode.data)
                _check_columns(opened, table, [*keys.values(), "episode_index"])
            rows, at = rows_of_episode(table, episode), slice(starts[place], starts[place + 1])
            for name, key in keys.items():
                values = vectors(rows, opened, key, widths[name])
                if name in origin:
                    values = values - np.array(origin[name])
                numbers[name][at] = values
                labels = layout.names(key) or [f"{key}[{place}]" for place in range(widths[name])]
                if key not in swallowed and look_at_numbers(values, labels, opened, f"pass origin={{{name!r}: ...}}"):
                    swallowed.add(key)
            if "timestamp" in rows.column_names:
                source = f"{opened}, episode {episode.number}"
                time[at], stamped[at] = repaired_times(rows["timestamp"].to_numpy(), layout.fps, source)
            else:
                time[at] = np.arange(episode.length) / layout.fps
            if episode.video is None:
                _put_images(layout, episode, rows, starts[place], frames)
                _check_seen(episode, frames.observed[at, 0])
            else:
                videos.setdefault(episode.video, []).append(place)
        for file, places in videos.items():
            index = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in places])
            begin = np.repeat([layout.episodes[k].begin for k in places], [lengths[k] for k in places])
            for near, image in frames_at_times(file, begin + time[index], 0.5 / layout.fps):
                frames.put(index[near], image, file)
            for k in places:
                _check_seen(layout.episodes[k], frames.observed[starts[k] : starts[k + 1], 0])
    finally:
        frames.close()
    out = TensorDict(
        {
            "image": torch.from_numpy(frames.images),
            "observed": torch.from_numpy(frames.observed),
            **{name: torch.from_numpy(values) for name, values in numbers.items()},
            "time": torch.from_numpy(time[:, None]),
            "frame": torch.cat([torch.arange(length) for length in lengths])[:, None],
            "episode": torch.tensor([e.number for e in layout.episodes]).repeat_interleave(torch.tensor(lengths)),
        },
        batch_size=[int(starts[-1])],
    )
    return mask_invalid_rows(out, torch.from_numpy(stamped), str(layout.root))


def _check_columns(file: Path, table, columns: Sequence[str]) -> None:
    missing = sorted(set(columns) - set(table.column_names))
    if missing:
        raise ValueError(f"{file} lacks the columns {missing}; it has {table.column_names}")


def _put_images(layout: Layout, episode: EpisodeFiles, rows, start: int, frames: _Frames) -> None:
    column = rows[layout.camera] if layout.camera in rows.column_names else [None] * episode.length
    for frame, value in enumerate(column):
        value = value if value is None else value.as_py()
        image = decode_image(layout.root, layout.camera, episode.number, frame, value)
        if image is not None:
            frames.put(np.array([start + frame]), image, f"frame {frame} of {episode.data}")


def _check_seen(episode: EpisodeFiles, seen: np.ndarray) -> None:
    """Warns of missing frames; raises for an episode without any."""
    source = episode.video or episode.data
    if not seen.any():
        raise ValueError(
            f"{source} shows none of the {episode.length} frames of episode {episode.number}; download it again"
        )
    missing = np.flatnonzero(~seen).tolist()
    if missing:
        some = ", ".join(map(str, missing[:10])) + (f" and {len(missing) - 10} more" if len(missing) > 10 else "")
        warnings.warn(
            f"{source}: of episode {episode.number} these frames cannot be decoded and count as missing (observed "
            f"False): {some}",
            stacklevel=2,
        )
