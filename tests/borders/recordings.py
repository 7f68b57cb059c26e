"""One's own recordings: tables, videos, images, rows in memory."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import INF, NAN, gone, kept, put, renamed, same, spoiled
from benchmarks.reliability.documents import edited
from benchmarks.reliability.target import Source, Subject, Target, targets_of
from tests.borders.folders import ALL_ROWS, SIZES, made, one_row, picture
from tests.data.lerobot.lerobot_folder import SIZE as SMALL
from tests.data.recordings.own_files import write_csv, write_images, write_video
from torch_denkf.applications.car.kitti.trajectories import write_trajectory
from torch_denkf.data import Images, LeRobotReplay, Recording, RecordingReplay, Table, Video
from torch_denkf.data.lerobot.rows import recording_from_rows


def _write_own(root: Path) -> None:
    time = np.arange(12) / 10
    columns = {"time": time, "x": np.sin(time), "y": np.cos(time)}
    write_csv(root / "table.csv", **columns)
    parquet.write_table(pa.table(columns), root / "table.parquet")
    write_csv(root / "stamps.csv", time=time)
    write_video(root / "run.mkv", 12)
    write_images(root / "images", [f"{k / 10:.1f}.png" for k in range(12)])


def read_own(root: Path, *, camera: str = "", table: str = "table.csv", replay: Any = None, **options: Any) -> Any:
    """Returns all rows, as a user reads them."""
    streams: dict[str, Any] = {"state": Table(root / table, **options)}
    if camera == "video":
        streams["camera"] = Video(root / "run.mkv", times=root / "stamps.csv")
    elif camera:
        streams["camera"] = Images(root / "images")
    return RecordingReplay(Recording(**streams), **{"size": SMALL, **ALL_ROWS, **(replay or {})})[:]


own = made("own", _write_own)  # a table as CSV and as Parquet, a video, and a folder of images
OWN = Source("recordings", own, read_own)


def _shown(result: TensorDict, camera: str = "images") -> bool:
    """Tells whether each row that counts as seen shows its own picture, and all numbers are as without damage."""
    expected, places = OWN.reference(camera=camera), result["time"].squeeze(-1)
    if same(result, expected):
        return True
    rows = [int((expected["time"].squeeze(-1) - time).abs().argmin()) for time in places]
    seen = result["observed"].squeeze(-1)
    equal = all(torch.equal(result[key], expected[key][rows]) for key in ("state", "state_observed") if key in result)
    pictures = torch.equal(result["pixels"][seen], expected["pixels"][rows][seen])
    return d.finite(result) and equal and pictures and not bool(result["pixels"][~seen].any()) and len(result) >= 10


CELLS = d.of("nan", "one", "", "inf", "1_1", "1e39", "x,1")  # the last but one is infinite in float32
TIMES = d.Wrong({"back": "0.05", "the same": "0.3", "an hour on": "3600.4", "1e300": "1e300", "negative": "-3"})
TABLES: dict[str, d.Change] = {
    "no header": lambda rows: rows[1:],
    "only a header": lambda rows: rows[:1],
    "one row": lambda rows: rows[:2],
    "an empty name": put((0, 1), ""),
    "no time": put((0, 0), "u"),
    "sorted backwards": lambda rows: [rows[0], *rows[:0:-1]],
    "an open quote": put((5, 0), '"'.__add__),
    "a line of a megabyte": put(5, ["9" * (1 << 20)]),
    "only times": lambda rows: [row[:1] for row in rows],
    "an empty line": put((5, 0), "\n".__add__),
}
IMAGE_FILES = {
    **{f"a name that is {what}": renamed(f"{what}.png") for what in ("half", "nan", "inf")},
    "a time twice": lambda file: file.with_name("0.50.png").write_bytes(file.read_bytes()),
    "a frame twice": lambda file: file.with_suffix(".jpg").write_bytes(file.read_bytes()),
    "a pipe": lambda file: os.mkfifo(file.with_name("0.55.png")),
    "a link to nowhere": lambda file: file.with_name("0.55.png").symlink_to("nowhere"),
    "another size": picture((5, 7), ".png"),
    "no folder": lambda file: gone(file.parent),
    "no images": lambda file: [gone(one) for one in file.parent.iterdir()],
}


def _named(name: bytes, folder: Path) -> Any:
    """Reads a video of this name; a crash of OpenCV ends the process."""
    file = shutil.copy(own() / "run.mkv", folder / os.fsdecode(name))
    return Video(file).read(SMALL, None, False)


def rows_in_memory(change: d.Change = lambda rows: None, fps: Any = 10.0) -> Any:
    """Returns rows that are in memory."""
    state = torch.rand(12, 2, generator=torch.Generator().manual_seed(0))
    rows = TensorDict({"observation": {"image": torch.zeros(12, 3, 8, 8, dtype=torch.uint8), "state": state}}, [12])
    rows["episode"] = torch.arange(3).repeat_interleave(4)
    change(rows)
    return LeRobotReplay(recording_from_rows(rows, fps=fps), split="all")[:]


def _row_masked(result: TensorDict) -> bool:
    """Tells whether the damaged row counts neither as seen nor in a loss, and all others are as without damage."""
    masks = ("observed", "state_observed", ("collector", "mask"))
    return all(not bool(result[mask][1].any()) for mask in masks) and kept(result, rows_in_memory())


IMAGE, STATE = ("observation", "image"), ("observation", "state")
IN_MEMORY: dict[str, d.Change] = {
    "state nan": put(STATE, spoiled((1, 1), NAN)),
    "image of two dimensions": put(IMAGE, lambda image: image[:, 0, 0]),
    "image of five channels": put(IMAGE, lambda image: image[:, :1].expand(12, 5, 8, 8).clone()),
    "episode as floats with nan": put("episode", lambda episode: episode * NAN),
    "episode in two parts": put("episode", spoiled(slice(10, 12), 0)),
    **{f"{path[-1]} missing": put(path, d.MISSING) for path in (STATE, IMAGE, ("episode",))},
}


def _files() -> Iterator[Target]:
    parquet_file, named = "table.parquet", {"table": "table.parquet"}
    video, images, image = {"camera": "video"}, {"camera": "images"}, "images/0.5.png"
    yield OWN.target("table.csv", d.FILE, file="table.csv", rights={"cut by a byte": OWN.like()})
    yield OWN.target(parquet_file, d.BYTES.but(), OWN.like(), file=parquet_file, options=named)
    yield OWN.target(f"{parquet_file} in its place", d.PLACES, file=parquet_file, options=named)
    names = lambda place: place[0] == 0 or len(place) == 1  # noqa: E731  # names, and rows that may be missing
    yield from OWN.document("table.csv", None, ("table",), skip=names, but=("'--1'",))
    yield from OWN.document(parquet_file, None, ("table",), skip=one_row, options=named)
    # An hour's gap in a table is one: readings are as they stand there.
    times = (TIMES | d.of("1_0", "inf")).each(lambda value: edited(put((5, 0), value)))
    yield OWN.target(
        "time goes on by", times, None, ("table.csv:6", "table.csv:7"), "table.csv", rights={"an hour on": d.finite}
    )
    cells = CELLS.each(lambda value: edited(put((2, 1), value)))
    yield OWN.target("x in line 3", cells, None, "table.csv:3", "table.csv")
    columns = {"lists": lambda column: [[value] for value in column], "text": lambda column: ["x" for _ in column]}
    changes = d.Wrong(columns).each(lambda change: edited(put("x", change)))
    yield OWN.target("column x", changes, None, parquet_file, parquet_file, named)
    later = edited(lambda rows: [rows[0], *([f"1{row[0]}", *row[1:]] for row in rows[1:])])
    yield OWN.target("times of another clock", later, None, "start", "table.csv", video)
    lines, rights = d.Wrong(TABLES).each(edited), dict.fromkeys(("an empty name", "an empty line"), OWN.like())
    yield OWN.target("table.csv's lines", lines, None, ("table.csv", "table"), "table.csv", rights=rights)
    # A video has no checksum: of a flipped byte a picture may be wrong, and nothing can tell.
    yield OWN.target("video", d.CUT, partial(_shown, camera="video"), ("run.mkv", "stamps.csv"), "run.mkv", video)
    yield OWN.target("video in its place", d.PLACES, None, ("run.mkv", "/dev/zero"), "run.mkv", video)
    ends = {"cut by a byte": OWN.like(camera="video")}
    yield OWN.target("video's stamps", d.FILE, None, "stamps.csv", "stamps.csv", video, rights=ends)
    latin = d.of(b"caf\xe9.mkv", b"\xff.mkv", b"\xed\xa0\x80.mkv")
    yield Target("recordings", "a video's name", ("name",), _named, latin, needs=own)
    words = ("images", "0.5.png", "half.png", "nan.png", "inf.png", "0.50.png", "0.5.jpg", "0.55.png")
    yield OWN.target("image", d.SEALED | d.PLACES, _shown, words, image, images)
    yield OWN.target("images", IMAGE_FILES, None, words, image, images)
    act, rights = (lambda change, folder: rows_in_memory(change)), {"state nan": _row_masked}
    words = ("state", "image", "episode")
    yield Target("recordings", "recording_from_rows", words, act, d.Wrong(IN_MEMORY), rights=rights)


# -------------------------------------------------------------------------------------------------------- arguments


def _trajectory(**given: Any) -> Any:
    """Returns a path that is written for other programs."""
    layout = {"layout": "tum"} if "times" in given else {}
    return write_trajectory("path.txt", **{"trajectory": torch.zeros(5, 3), **layout, **given})


def _two(columns: list[str], stream: str, name: str) -> list[Recording]:
    """Returns two recordings of the same file, which do not go together."""
    first, second = Table(own() / "table.csv", ["x"]), Table(own() / "table.csv", columns)
    return [Recording(state=first), Recording(name=name, **{stream: second})]


TWO = {"names": (["x"], "state", "table"), "columns": (["y"], "state", "b"), "streams": (["x"], "imu", "b")}
TAKEN = ("time", "_row", "_reset", "reward", "recorded", "belief", "state_observed")


def _made(streams: Any) -> Any:
    streams = streams() if callable(streams) else streams
    return RecordingReplay(streams, **ALL_ROWS) if isinstance(streams, list) else Recording(**streams)


def _arguments() -> Iterator[Subject]:
    table = {
        "columns": d.of(["z"], "x", [], 3),
        "time": d.of("stamp", 3),
        "unit": d.of("h", 3),
        "sample": d.of("first", 3),
        "origin": d.of({"z": 1.0}, {"x": NAN}, {"x": "far"}, {"x": [1.0, 2.0]}, 5.0),
        "tolerance": d.POSITIVE.but("inf"),
    }
    replay = {
        "clock": d.of(0.0, -1.0, NAN, INF, "sun", 1e12),
        "size": SIZES,
        "test_share": d.SHARE.but("inf"),
        "batch_size": d.COUNT_OR_NONE,
        "slice_len": d.COUNT.but("fraction"),
    }
    path = {
        "trajectory": d.of(torch.full((5, 3), NAN), torch.zeros(5, 2), torch.zeros(5), "path"),
        "layout": d.of("csv"),
        "times": d.of(None, torch.zeros(3), torch.full((5,), NAN), torch.arange(5.0).flip(0)),
    }
    streams = {
        "none": {},
        "text": {"state": "table.csv"},
        **{f"{what} told apart": partial(_two, *options) for what, options in TWO.items()},
        "two cameras": {name: Images(name, rate=1.0) for name in "ab"},
        **{f"{name}, a name that is taken": {name: Table("table.csv")} for name in TAKEN},
        "a name that is no text": {"name": 3, "state": Table("table.csv")},
        "no recordings": [],
        "recordings of text": ["table.csv"],
    }
    words = {"streams": ("state", "camera", *TAKEN, "name", "recordings", "Recording")}
    images = lambda **given: Images(own() / "images", **given)  # noqa: E731
    replayed = lambda **given: read_own(own(), replay=given)  # noqa: E731
    in_memory = lambda **given: rows_in_memory(**given)  # noqa: E731
    yield OWN.arguments("Table", wrong=table, also=dict.fromkeys(table, ("table.csv",)))
    slices = dict.fromkeys(("clock", "slice_len"), ("rows", "slices"))
    yield Subject(replayed, wrong=replay, also=slices, name="RecordingReplay")
    videos = lambda **given: Video(own() / "run.mkv", **given).read(SMALL, None, False)  # noqa: E731
    times = d.of([*range(12, 0, -1)], [0.0, NAN, *range(2, 12)], [*range(11)])
    yield Subject(images, wrong={"start": d.FINITE, "rate": d.POSITIVE}, name="Images")
    yield Subject(videos, wrong={"times": times, "start": d.FINITE, "sample": d.of("linear")}, name="Video")
    yield Subject(in_memory, wrong={"fps": d.POSITIVE}, name="recording_from_rows")
    yield Subject(_trajectory, wrong=path, name="write_trajectory")
    yield Subject(_made, wrong={"streams": d.Wrong(streams)}, also=words, name="Recording")


def targets() -> Iterator[Target]:
    """Yields all files and arguments."""
    yield from _files()
    yield from targets_of("recordings", *_arguments())
