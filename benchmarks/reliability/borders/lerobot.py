"""Recordings in LeRobot's layout."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders.kitti import bomb
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.damage import finite, gone, kept
from benchmarks.reliability.documents import edited
from benchmarks.reliability.target import Folder, Target, targets_of
from tests.data.lerobot.lerobot_folder import SIZE, write_version_2, write_version_3
from torch_denkf.data import LeRobotReplay

LENGTHS = [6, 5, 7]
INFO, EPISODES = "meta/info.json", "meta/episodes.jsonl"
EPISODES_3 = "meta/episodes/chunk-000/file-000.parquet"
DATA = "data/chunk-000/episode_000001.parquet"
CAMERA = "observation.images.top"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mkv"


@cache
def sound(version: int) -> Path:
    """Three episodes: of version 2 with pictures in the tables, of version 3 with a video."""
    root = workshop() / f"lerobot{version}"
    root.mkdir()
    if version == 2:
        apart(lambda: write_version_2(root, LENGTHS, images="bytes"))
    else:
        apart(lambda: write_version_3(root, [LENGTHS[:2], LENGTHS[2:]]))
    return root


def read(root: Path, **options: Any) -> TensorDict:
    """All rows, as a user reads them."""
    data = LeRobotReplay(root, **{"size": SIZE, "split": "all", "cache": None, "progress": False, **options})
    return data[:]


V2, V3 = (Folder("lerobot", partial(sound, version), read) for version in (2, 3))


def _kept(result: TensorDict) -> bool:
    """Right where rows are as without damage, or those of the damaged episode are marked; stamps are rounded."""
    return kept(result, V2.reference(), most=LENGTHS[1], rtol=1e-6)


def _shown(result: TensorDict) -> bool:
    """Right where every row that counts as seen shows its own picture, but for a codec's rounding."""
    expected = V3.reference()
    seen = result["observed"].squeeze(-1)
    numbers = [key for key in expected.keys(True, True) if key != "pixels" and key != "observed"]
    equal = all(torch.equal(result[key], expected[key]) for key in numbers)
    off = (result["pixels"] - expected["pixels"])[seen].abs().flatten(1).mean(-1)
    return finite(result) and equal and bool((off < 0.02).all()) and not bool(result["pixels"][~seen].any())


def _planted(file: Path) -> None:
    """A picture outside the data set that is there."""
    (file.parents[3] / "secret.png").write_bytes(parquet.read_table(file)[CAMERA][2].as_py()["bytes"])
    edited(d.put((CAMERA, 2), {"bytes": None, "path": "../secret.png"}))(file)


COLUMNS = {
    "all nan": lambda column: [[float("nan")] * len(cell) for cell in column],
    "text": lambda column: ["x"] * len(column),
    "backwards": lambda column: column[::-1],
    "all zero": lambda column: [0] * len(column),
    "a repeated value": lambda column: [*column[:2], column[1], *column[3:]],
    "far on from the third on": lambda column: [*column[:2], *(value - 86400 for value in column[2:])],
}
PICTURES = d.of(*({"bytes": None, "path": path} for path in ("/etc/passwd", "../../etc/passwd", "no.png", "/dev/zero")))
ROWS = {
    "a row less": lambda columns: {name: column[:-1] for name, column in columns.items()},
    "a row more": lambda columns: {name: [*column, column[-1]] for name, column in columns.items()},
}
ARGUMENTS = {
    "camera": d.of("bottom", 3, "../.."),
    "state_key": d.of("nothing", CAMERA, 3),
    "action_key": d.of("nothing", CAMERA),
    "size": d.SIZE | {"fractions": (1.5, 2.5)},
}
ALSO = {"state_key": ("feature",), "action_key": ("feature",)}


def targets() -> Iterator[Target]:
    """All of a recording, and the arguments of what reads it."""
    yield V2.target("info.json", d.FILE, file=INFO)
    yield V2.target("episodes.jsonl", d.FILE, file=EPISODES, rights={"cut by a byte": V2.equal})
    yield V3.target("episodes of version 3", d.BYTES.but().each(d.written), V3.equal, file=EPISODES_3)
    yield V2.target("data", d.FILE.but(), _kept, ("episode_000001.parquet", "episode 1"), DATA)
    files = ("info.json", "episode_000002.parquet", "file-000.parquet", "file-000.mkv", "metadata", "episode 1")
    action = ("features", "action")  # a data set may have none
    unread = {"dtype", "names", "video_path", "timestamp", CAMERA}
    loose = lambda place: bool(unread & set(place))  # noqa: E731
    yield from V2.document(INFO, V2.equal, files, skip=lambda place: place == action, loose=loose)
    yield from V3.document(INFO, V3.equal, files, skip=lambda place: place != ("video_path",))
    rows, tasks = (lambda place: len(place) == 1), (lambda place: "tasks" in place)
    yield from V2.document(EPISODES, V2.equal, files, skip=rows, loose=tasks)
    unread = lambda place: place[0] in ("stats/unused", f"videos/{CAMERA}/to_timestamp")  # noqa: E731
    yield from V3.document(EPISODES_3, V3.equal, files, loose=unread)
    # Without the column of numbers, nothing is compared with it.
    counts = lambda place: place[0] not in ("frame_index", "episode_index") or len(place) == 1  # noqa: E731
    yield from V2.document(DATA, _kept, files, loose=counts)
    for key in ("observation.state", "action", "timestamp", "frame_index", "episode_index"):
        vector = key in ("observation.state", "action")
        names = list(COLUMNS)[:2] if vector else list(COLUMNS)[1:]
        wrong = d.Wrong({what: COLUMNS[what] for what in names}).each(
            lambda change, key=key: edited(d.put((key,), change))
        )
        yield V2.target(f"column {key}", wrong, _kept if key != "frame_index" else None, (*files, key), DATA)
    pictures = (PICTURES | {"a bomb": lambda cell: {**cell, "bytes": bomb(cell["bytes"])}}).each(
        lambda value: edited(d.put((CAMERA, 2), value))
    )
    yield V2.target("picture", pictures, _kept, (*files, CAMERA), DATA)
    yield V2.target("rows", d.Wrong(ROWS).each(edited), None, files, DATA)
    yield V2.one("picture of a file outside that is there", _planted, (*files, "secret.png"), file=DATA, right=_kept)
    for name in ("", "data", "meta"):
        yield V2.one(f"no {name or 'root'}", gone, ("info.json", "data", "meta"), file=name)
    # A video has no checksum: of a flipped byte a picture may be wrong, and nothing can tell.
    flips = [what for what in d.BYTES.named if "flipped" in what]
    yield V3.target("video", d.BYTES.but(*flips).each(d.written), _shown, file=VIDEO)
    yield V3.target("video in its place", d.PLACES, file=VIDEO)
    yield from targets_of("lerobot", V2.arguments("LeRobotReplay", wrong=ARGUMENTS, also=ALSO))
