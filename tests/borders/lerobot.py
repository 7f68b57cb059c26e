"""Data sets in LeRobot's layout, and what reads them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import NAN, gone, kept, put, same
from benchmarks.reliability.documents import edited
from benchmarks.reliability.target import Source, Subject, Target, targets_of
from tests.borders.folders import ALL_ROWS, SIZES, bomb, made, one_row
from tests.data.lerobot.lerobot_folder import SIZE as SMALL
from tests.data.lerobot.lerobot_folder import png, write_version_2, write_version_3
from torch_denkf.data import LeRobotReplay

LENGTHS = [6, 12, 7]
INFO, EPISODES = "meta/info.json", "meta/episodes.jsonl"
EPISODES_3 = "meta/episodes/chunk-000/file-000.parquet"
DATA = "data/chunk-000/episode_000001.parquet"
CAMERA = "observation.images.top"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mkv"


def read_episodes(root: Path, **options: Any) -> TensorDict:
    """Returns all rows, as a user reads them."""
    return LeRobotReplay(root, **{"size": SMALL, **ALL_ROWS, **options})[:]


#: Three episodes: of version 2 with pictures in the tables, of version 3 with a video.
V2 = Source("lerobot", made("lerobot2", partial(write_version_2, lengths=LENGTHS, images="bytes")), read_episodes)
V3 = Source("lerobot", made("lerobot3", lambda root: write_version_3(root, [[6, 5], [7]])), read_episodes)


def _rows_kept(result: TensorDict) -> bool:
    """Tells whether rows are as without damage, or those of the damaged episode are marked; stamps are rounded."""
    return kept(result, V2.reference(), most=LENGTHS[1], rtol=1e-6)


def _row_masked(key: str, result: TensorDict) -> bool:
    """Tells whether row 2 of the damaged episode counts as missing in an entry, and all else is as without damage."""
    expected, row = V2.reference().clone(), LENGTHS[0] + 2
    expected["observed"][row] = False
    if key == "pixels":
        expected["pixels"][row] = 0
    return same(result, expected, atol=1e-6)


def _video_shown(result: TensorDict) -> bool:
    """Tells whether every row that counts as seen shows its own picture, except for a codec's rounding."""
    expected = V3.reference()
    seen = result["observed"].squeeze(-1)
    numbers = [key for key in expected.keys(True, True) if key != "pixels" and key != "observed"]
    equal = all(torch.equal(result[key], expected[key]) for key in numbers)
    off = (result["pixels"] - expected["pixels"])[seen].abs().flatten(1).mean(-1)
    return d.finite(result) and equal and bool((off < 0.02).all()) and not bool(result["pixels"][~seen].any())


def _planted(file: Path) -> None:
    """A picture outside the data set that is there."""
    (file.parents[3] / "secret.png").write_bytes(parquet.read_table(file)[CAMERA][2].as_py()["bytes"])
    edited(put((CAMERA, 2), {"bytes": None, "path": "../secret.png"}))(file)


#: Columns of vectors, and of numbers.
VECTORS = {
    "all nan": lambda column: [[NAN] * len(cell) for cell in column],
    "text": lambda column: ["x"] * len(column),
    "too wide": lambda column: [[*cell, 1.0] for cell in column],
}
SCALARS = {
    "text": lambda column: ["x"] * len(column),
    "backwards": lambda column: column[::-1],
    "all zero": lambda column: [0] * len(column),
    "all nan": lambda column: [NAN] * len(column),
    "a repeated value": lambda column: [*column[:2], column[1], *column[3:]],
    "far on from the third on": lambda column: [*column[:2], *(value - 86400 for value in column[2:])],
}
ROWS = {
    "a row less": lambda columns: {name: column[:-1] for name, column in columns.items()},
    "a row more": lambda columns: {name: [*column, column[-1]] for name, column in columns.items()},
}


def _files() -> Iterator[Target]:
    words = ("info.json", "episode_000002.parquet", "file-000.parquet", "file-000.mkv", "metadata", "episode 1")
    yield V2.target("info.json", d.FILE, file=INFO)
    yield V2.target("episodes.jsonl", d.FILE, file=EPISODES, rights={"cut by a byte": V2.like()})
    yield V3.target("episodes of version 3", d.BYTES.but(), V3.like(), file=EPISODES_3)
    yield V2.target("data", d.FILE.but(), _rows_kept, ("episode_000001.parquet", "episode 1"), DATA)
    unread = {"dtype", "names", "video_path", "timestamp", CAMERA}
    loose, action = (lambda place: bool(unread & set(place))), ("features", "action")  # a data set may have none
    yield from V2.document(INFO, V2.like(), words, skip=lambda place: place == action, loose=loose)
    yield from V3.document(INFO, V3.like(), words, skip=lambda place: place != ("video_path",))
    yield from V2.document(EPISODES, V2.like(), words, skip=one_row, loose=lambda place: "tasks" in place)
    unread_3 = ("stats/unused", f"videos/{CAMERA}/to_timestamp")
    yield from V3.document(EPISODES_3, V3.like(), words, loose=lambda place: place[0] in unread_3)
    # Without the column of numbers, nothing is compared with it.
    counts = lambda place: place[0] not in ("frame_index", "episode_index") or len(place) == 1  # noqa: E731
    yield from V2.document(DATA, _rows_kept, words, loose=counts)
    columns = {**dict.fromkeys(("observation.state", "action"), VECTORS), "timestamp": SCALARS}
    for key, wrong in {**columns, "frame_index": SCALARS, "episode_index": SCALARS}.items():
        changes = d.Wrong(wrong).each(lambda change, key=key: edited(put(key, change)))
        right = _rows_kept if key != "frame_index" else None
        yield V2.target(f"column {key}", changes, right, (*words, key), DATA)
    elsewhere = ("/etc/passwd", "../../etc/passwd", "no.png", "/dev/zero")
    pictures = d.Wrong({path: {"bytes": None, "path": path} for path in elsewhere})
    pictures |= {"a bomb": lambda cell: {**cell, "bytes": bomb(cell["bytes"])}}
    cells = pictures.each(lambda value: edited(put((CAMERA, 2), value)))
    yield V2.target("picture", cells, partial(_row_masked, "pixels"), (*words, CAMERA), DATA)
    yield V2.target("picture of a file outside that is there", _planted, _rows_kept, (*words, "secret.png"), DATA)
    frames = {
        "one of another size": put((CAMERA, 2), {"bytes": png(np.zeros((24, 32, 3), np.uint8)), "path": None}),
        "none that is there": put(CAMERA, lambda column: [None] * len(column)),
    }
    yield V2.target("frames", d.Wrong(frames).each(edited), None, "episode_000001.parquet", DATA)
    stamps = d.of(0.1, 0.05, NAN, -1.0, 1e6).each(lambda value: edited(put(("timestamp", 2), value)))
    yield V2.target("stamp 2", stamps, partial(_row_masked, "time"), file=DATA)
    zeros = d.of("fps", "chunks_size").each(lambda key: edited(put(key, 0)))
    yield V2.target("zero as", zeros, None, words, INFO)
    much = edited(put((1, "length"), 10**12))
    yield V2.target("an episode of 1e12 rows", much, file=EPISODES)
    twice = {EPISODES: lambda rows: [*rows, rows[0]], EPISODES_3: ROWS["a row more"]}
    for source, (file, change) in zip((V2, V3), twice.items(), strict=True):
        yield source.target(f"an episode twice in {Path(file).name}", edited(change), file=file)
    yield V2.target("rows", d.Wrong(ROWS).each(edited), None, words, DATA)
    for name in ("", "data", "meta"):
        yield V2.target(f"no {name or 'root'}", gone, None, ("info.json", "data", "meta"), name)
    # A video has no checksum: of a flipped byte a picture may be wrong, and nothing can tell.
    yield V3.target("video", d.CUT, _video_shown, file=VIDEO)
    yield V3.target("video in its place", d.PLACES, file=VIDEO)


# -------------------------------------------------------------------------------------------------------- arguments


def _arguments() -> Iterator[Subject]:
    wrong = {
        "camera": d.of("bottom", 3, "../.."),
        "state_key": d.of("nothing", CAMERA, 3),
        "action_key": d.of("nothing", CAMERA),
        "size": SIZES,
    }
    yield V2.arguments("LeRobotReplay", wrong=wrong, also=dict.fromkeys(wrong, ("feature",)))


def targets() -> Iterator[Target]:
    """Yields all files and arguments."""
    yield from _files()
    yield from targets_of("lerobot", *_arguments())
