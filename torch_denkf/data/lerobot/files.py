"""Reads LeRobot's layout on disk, versions 2.0, 2.1 and 3.0: metadata, tables, and paths of videos and images.

::

    meta/info.json                                      version, fps, features, the two templates of paths
    meta/episodes.jsonl                                 2.x: number and length of each episode
    meta/episodes/chunk-CCC/file-FFF.parquet            3.0: also the episode's files, and its start in the video
    data/chunk-CCC/episode_EEEEEE.parquet               2.x: tables (and images); 3.0: file-FFF.parquet, many episodes
    videos/chunk-CCC/CAMERA/episode_EEEEEE.mp4          2.x; 3.0: videos/CAMERA/chunk-CCC/file-FFF.mp4
    images/CAMERA/episode_EEEEEE/frame_FFFFFF.png       if images are neither in videos nor in the parquet files

Source: github.com/huggingface/lerobot, ``lerobot.datasets``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from typing import Any

import numpy as np

from torch_denkf._checks import check_count, check_number
from torch_denkf.data.parquet import read_parquet
from torch_denkf.data.pictures import decode_picture
from torch_denkf.data.text import read_lines

VERSIONS = {"v2.0": 2, "v2.1": 2, "v3.0": 3}
MOST_ROWS = 10**8  # of a data set: 38 days at 30 a second
COMPLETE = "download the data set completely"
_WIDTH = re.compile(r"0?\d{0,2}d?")


@dataclass(frozen=True)
class EpisodeFiles:
    """Files of one episode.

    Attributes:
        number: number of the episode.
        length: number of rows.
        data: the parquet file.
        video: video of the camera, None if it has images.
        begin: start of the episode in the video, s.
    """

    number: int
    length: int
    data: Path
    video: Path | None
    begin: float


@dataclass(frozen=True)
class Layout:
    """A data set's metadata, for one camera.

    Attributes:
        root: the folder.
        fps: rows per second.
        features: features of ``info.json``: dtype, shape and names by key.
        camera: key of the camera.
        episodes: files of the episodes, sorted by number.
        empty: episodes without rows.
        meta: files with the metadata.
    """

    root: Path
    fps: float
    features: dict[str, dict[str, Any]]
    camera: str
    episodes: tuple[EpisodeFiles, ...]
    empty: tuple[EpisodeFiles, ...]
    meta: tuple[Path, ...]

    def width(self, key: str) -> int:
        """Returns the number of components of a feature.

        Raises:
            ValueError: if there is no such feature, or it is no vector.
        """
        if key not in self.features:
            raise ValueError(f"{self.root} has no feature {key!r}; it has {sorted(self.features)}")
        feature = self.features[key]
        if len(feature["shape"]) != 1 or feature["dtype"] in ("string", "image", "video"):
            raise ValueError(f"feature {key!r} of {self.root} is no vector: {feature['dtype']} {feature['shape']}")
        width = feature["shape"][0]
        check_count(f"the width of feature {key!r} in {self.meta[0]}", width)
        return int(width)

    def names(self, key: str) -> tuple[str, ...] | None:
        """Returns the names of a feature's components from lists, nested lists, or lists under a common name."""
        names = self.features[key].get("names")
        if isinstance(names, dict):
            names = list(names.values())
        if isinstance(names, list):
            names = [name for part in names for name in (part if isinstance(part, list) else [part])]
        if not isinstance(names, list) or len(names) != self.width(key):
            return None
        return tuple(str(name) for name in names)


def read_layout(root: Path, camera: str | None, chosen: Sequence[int] | None = None) -> Layout:
    """Reads the metadata of a LeRobot folder.

    Args:
        root: the folder.
        camera: key of the camera; None for the only one.
        chosen: numbers of the episodes; None for all.

    Raises:
        FileNotFoundError: without metadata.
        ValueError: for unsupported versions, unknown cameras and episodes, malformed metadata, numbers out of range,
            episodes that are listed twice, totals that contradict the list, and paths that lead out of the folder.
    """
    file = root / "meta" / "info.json"
    if not file.is_file():
        raise FileNotFoundError(f"no {file}; pass the folder of a LeRobot data set, which holds meta and data")
    try:
        info = json.loads("\n".join(read_lines(file)))
        version, fps, features = info["codebase_version"], float(info["fps"]), dict(info["features"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file} is malformed ({type(error).__name__}: {error}); download it again") from error
    check_number(f"fps in {file}", fps, above=0, cure="It is the number of rows per second")
    _check_features(file, features)
    if not isinstance(version, str) or version not in VERSIONS:
        raise ValueError(f"{file} is of LeRobot's version {version!r}; this reader knows {', '.join(VERSIONS)}")
    camera = _choose_camera(root, features, camera)
    stay_inside(root, f"images/{camera}", f"{file}, by the name of a camera,")
    if VERSIONS[version] == 2:
        episodes, meta = _episodes_of_version_2(root, info, camera)
    else:
        episodes, meta = _episodes_of_version_3(root, info, camera)
    _check_episodes(meta, episodes)
    if chosen is None:
        _check_totals(file, info, meta[0], episodes)
    else:
        episodes = _chosen(chosen, meta[0], episodes)
    empty = tuple(episode for episode in episodes if not episode.length)
    episodes = [episode for episode in episodes if episode.length]
    if not episodes:
        raise ValueError(f"{root} has no episodes: {meta[0]} lists none; {COMPLETE}")
    rows = sum(episode.length for episode in episodes)
    if rows > MOST_ROWS:
        raise ValueError(
            f"{meta[0]} announces {rows} rows, more than the {MOST_ROWS} that are read; its numbers are wrong"
        )
    episodes.sort(key=lambda episode: episode.number)
    return Layout(root, fps, features, camera, tuple(episodes), empty, (file, *meta))


def _check_totals(file: Path, info: dict, listed: Path, episodes: Sequence[EpisodeFiles]) -> None:
    totals = {"total_episodes": len(episodes), "total_frames": sum(episode.length for episode in episodes)}
    for name, there in totals.items():
        if info.get(name, there) != there:
            raise ValueError(
                f"{file} announces {name} {info[name]!r}, but {listed} lists {there}; {COMPLETE}, or pass "
                "episodes= of those that are there"
            )


def _chosen(chosen: object, listed: Path, episodes: Sequence[EpisodeFiles]) -> list[EpisodeFiles]:
    there = [episode.number for episode in episodes]
    numbers = list(chosen) if isinstance(chosen, Iterable) and not isinstance(chosen, str | bytes) else []
    if not numbers:
        raise ValueError(f"episodes holds numbers of episodes, such as [0, 2], or is None for all; got {chosen!r}")
    if unknown := [number for number in numbers if number not in there]:
        raise ValueError(f"episodes names {unknown[:10]}, but {listed} lists {_some(sorted(there))}")
    return [episode for episode in episodes if episode.number in numbers]


def _some(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:10])) + (f" and {len(numbers) - 10} more" if len(numbers) > 10 else "")


def check_files(layout: Layout) -> None:
    """Checks that the files of all episodes exist, before hours of reading.

    Raises:
        FileNotFoundError: if files are missing; the message says how many, and which episodes are there.
    """
    missing: dict[Path, None] = {}
    whole = []
    for episode in layout.episodes:
        lost = [file for file in (episode.data, episode.video) if file is not None and not file.is_file()]
        missing |= dict.fromkeys(lost)
        whole += [] if lost else [episode.number]
    if not missing:
        return
    first, *others = missing
    more = f", nor {len(others)} more of its files, such as {others[0]}" if others else ""
    there = f", or pass episodes= of those that are there: {_some(whole)}" if whole else ""
    camera = "" if first.suffix == ".parquet" else ", pass another camera"
    raise FileNotFoundError(f"no {first}, which the data set's metadata names{more}; {COMPLETE}{camera}{there}")


def check_empty(layout: Layout) -> None:
    """Checks that episodes of length 0 have no rows.

    Raises:
        ValueError: if there are rows; the message names the file and the episode.
    """
    for episode in layout.empty:
        if episode.data.is_file():
            rows_of_episode(read_table(episode.data, ["episode_index"]), episode)


def _check_features(file: Path, features: dict) -> None:
    for key, feature in features.items():
        known = isinstance(feature, dict) and isinstance(feature.get("dtype"), str)
        if not known or not isinstance(feature.get("shape"), (list, tuple)):
            raise ValueError(
                f"{file} is malformed: feature {key!r} has no 'dtype' and 'shape', but {feature!r}; download it again"
            )


def _check_episodes(meta: list[Path], episodes: list[EpisodeFiles]) -> None:
    seen: set[int] = set()
    for episode in episodes:
        if episode.number in seen:
            raise ValueError(
                f"{meta[0]} lists episode {episode.number} twice, again as entry {len(seen) + 1} of {len(episodes)}; "
                "leave one out, or download it again"
            )
        seen.add(episode.number)


def _choose_camera(root: Path, features: dict[str, dict], camera: str | None) -> str:
    cameras = [key for key, feature in features.items() if _is_camera(feature)]
    if camera is None and len(cameras) == 1:
        return cameras[0]
    for name in cameras:
        if camera is not None and camera in (name, name.removeprefix("observation.images.")):
            return name
    if not cameras:
        file = root / "meta" / "info.json"
        raise ValueError(f"{file} names no camera: no feature of dtype video or image among {sorted(features)}")
    raise ValueError(
        f"{root} has no camera {camera!r}; it has {cameras}"
        if camera is not None
        else f"{root} has several cameras; pass camera=, one of {cameras}"
    )


def _is_camera(feature: dict) -> bool:
    details = feature.get("info") or feature.get("video_info") or {}
    depth = details.get("video.is_depth_map") or details.get("is_depth_map")
    return feature["dtype"] in ("video", "image") and not depth


def _episodes_of_version_2(root: Path, info: dict, camera: str) -> tuple[list[EpisodeFiles], list[Path]]:
    file = root / "meta" / "episodes.jsonl"
    if not file.is_file():
        raise FileNotFoundError(f"no {file}, which lists the episodes; {COMPLETE}")
    video = info["features"][camera]["dtype"] == "video"
    chunk = info.get("chunks_size", 1000)
    check_count(f"chunks_size in {root / 'meta' / 'info.json'}", chunk, cure="It is the episodes in a folder")
    episodes = []
    for at, line in enumerate(read_lines(file), start=1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
            number, length = entry["episode_index"], entry["length"]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{file} has a malformed line {line[:80]!r}, line {at} ({type(error).__name__}: {error}); download it "
                "again"
            ) from error
        for name, value in (("episode_index", number), ("length", length)):
            check_count(f"{name} in {file}:{at}", value, least=0)
        place = {"episode_chunk": number // chunk, "episode_index": number, "video_key": camera}
        data = _inside(root, info, "data_path", **place)
        shown = _inside(root, info, "video_path", **place) if video else None
        episodes.append(EpisodeFiles(number, length, data, shown, 0.0))
    return episodes, [file]


def _episodes_of_version_3(root: Path, info: dict, camera: str) -> tuple[list[EpisodeFiles], list[Path]]:
    files = sorted((root / "meta" / "episodes").glob("*/*.parquet"))
    if not files:
        raise FileNotFoundError(f"no {root / 'meta' / 'episodes'}/*/*.parquet, which list the episodes; {COMPLETE}")
    video = info["features"][camera]["dtype"] == "video"
    data_keys = ["data/chunk_index", "data/file_index"]
    video_keys = [f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    keys = ["episode_index", "length", *data_keys, *(video_keys if video else [])]
    episodes = []
    for file in files:
        for entry in read_table(file, keys).to_pylist():
            try:
                number, length, chunk, part, *where = (_whole(entry[key]) for key in keys[:6])
                begin = float(entry[keys[6]]) if video else 0.0
            except (TypeError, ValueError) as error:
                raise ValueError(f"{file} has a row with gaps or fractions, {entry}; download it again") from error
            for name, value in (("episode_index", number), ("length", length)):
                check_count(f"{name} in {file}", value, least=0)
            check_number(f"from_timestamp of episode {number} in {file}", begin, least=0)
            shown = None
            if video:
                place = {"video_key": camera, "chunk_index": where[0], "file_index": where[1]}
                shown = _inside(root, info, "video_path", **place)
            data = _inside(root, info, "data_path", chunk_index=chunk, file_index=part)
            episodes.append(EpisodeFiles(number, length, data, shown, begin))
    return episodes, files


def _whole(value: Any) -> int:
    """Returns a whole number, which may be stored as a float, or raises a ``ValueError``."""
    if int(value) != value:
        raise ValueError(f"{value} is no whole number")
    return int(value)


def _inside(root: Path, info: dict, name: str, **place: Any) -> Path:
    """Returns the path that a template of ``info.json`` gives.

    Raises:
        ValueError: if there is no such template, it has unknown fields, or it leads out of the folder.
    """
    file, template = root / "meta" / "info.json", info.get(name)
    if not isinstance(template, str):
        raise ValueError(f"{file} is malformed: {name!r} is no template of a path, but {template!r}; download it again")
    try:
        parts = list(Formatter().parse(template))
        fields = {field for _, field, _, _ in parts if field is not None}
        widths = [spec for _, _, spec, _ in parts if spec]
        strange = sorted(fields - set(place)) + [spec for spec in widths if not _WIDTH.fullmatch(spec)]
        if strange:
            raise ValueError(f"it has {strange[0]!r}, but may name {sorted(place)}, with widths such as 06d")
        path = template.format(**place)
    except (KeyError, IndexError, ValueError, AttributeError, TypeError) as error:
        raise ValueError(
            f"{file} has a path {name!r}, {template!r}, that cannot be filled in: {error}; download it again"
        ) from error
    return stay_inside(root, path, f"{file}, by {name!r},")


def read_table(file: Path, columns: list[str] | None = None):
    """Returns columns of a parquet file, or all, as a pyarrow table.

    Raises:
        ImportError: without pyarrow.
        FileNotFoundError: without the file.
        ValueError: if it is damaged, or lacks a column.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no {file}, which the data set's metadata names; {COMPLETE}")
    return read_parquet(file, columns)


def rows_of_episode(table, episode: EpisodeFiles):
    """Returns the rows of one episode.

    Raises:
        ValueError: if their number differs from the metadata, or they are not in order.
    """
    import pyarrow.compute as compute

    try:
        table = table.filter(compute.equal(table["episode_index"], episode.number))
    except (NotImplementedError, ValueError) as error:  # pyarrow's are both
        raise ValueError(f"{episode.data}: episode_index has no whole numbers ({error}); download it again") from error
    if table.num_rows != episode.length:
        raise ValueError(
            f"{episode.data} has {table.num_rows} rows of episode {episode.number}, but the metadata says "
            f"{episode.length}; download both again"
        )
    if "frame_index" in table.column_names:
        frame = table["frame_index"].to_numpy()
        if (frame != np.arange(episode.length)).any():
            raise ValueError(f"{episode.data}: frame_index of episode {episode.number} does not count from 0 by ones")
    return table


def vectors(table, file: Path, key: str, width: int) -> np.ndarray:
    """Returns a column of numbers, float64 ``[n, width]``.

    Raises:
        ValueError: if a row has another width, or none.
    """
    import pyarrow as arrow
    import pyarrow.compute as compute

    column = table[key].combine_chunks()
    if isinstance(column, arrow.ExtensionArray):
        column = column.storage
    listed = arrow.types.is_list(column.type) or arrow.types.is_large_list(column.type)
    widths = {1}
    if listed or arrow.types.is_fixed_size_list(column.type):
        widths = set(compute.list_value_length(column).to_pylist())
        column = column.flatten()
    if widths != {width} or column.null_count:
        found = "gaps" if column.null_count or None in widths else f"rows of {sorted(widths)} numbers"
        raise ValueError(f"{key!r} in {file} has {found}; meta/info.json says {width} in each row")
    return column.to_numpy(zero_copy_only=False).astype(np.float64).reshape(-1, width)


def decode_image(root: Path, camera: str, episode: int, frame: int, value: dict | None) -> np.ndarray | None:
    """Decodes an image stored in a parquet file, or named there, to RGB ``[H, W, 3]``; returns None on failure.

    Raises:
        ValueError: if the column contains no images.
    """
    if not isinstance(value, dict | None):
        raise ValueError(
            f"{camera!r} of episode {episode} in {root} holds no pictures with bytes or path, but {value!r:.80}; "
            "download the data set again"
        )
    data = (value or {}).get("bytes")
    if data is None:
        names = [(value or {}).get("path")]
        names += [f"images/{camera}/episode{m}{episode:06d}/frame{m}{frame:06d}.png" for m in "_-"]
        source = f"frame {frame} of episode {episode} in {root}"
        files = [stay_inside(root, name, source) for name in names if name]
        data = next((file.read_bytes() for file in files if file.is_file()), b"")
    return decode_picture(data)


def stay_inside(root: Path, path: str, source: str) -> Path:
    """Returns the path of a file that metadata name, which must be inside of a folder.

    Args:
        root: the folder.
        path: relative to it.
        source: name of the metadata, for the message.

    Raises:
        ValueError: if the path leads out of the folder.
    """
    file = root / path
    if ".." in Path(path).parts or not file.is_relative_to(root) or "\0" in path:
        raise ValueError(
            f"{source} names a file outside of the data set, {path!r}; such a data set may read anything of yours: "
            "download it from where you trust it, or correct the path"
        )
    return file
