"""One's own recordings: tables, videos, images."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.damage import finite, gone, kept, leaves, same
from benchmarks.reliability.documents import edited
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from tests.data.recordings.own_files import SIZE, write_csv, write_images, write_video
from torch_denkf.applications.car.kitti.trajectories import write_trajectory
from torch_denkf.data import Images, LeRobotReplay, Recording, RecordingReplay, Table, Video
from torch_denkf.data.lerobot.rows import recording_from_rows

ROWS = 12
NAN, INF = float("nan"), float("inf")


@cache
def sound() -> Path:
    """A table as CSV and as Parquet, a video, and a folder of images."""
    root = workshop() / "own"
    root.mkdir()
    apart(lambda: _write(root))  # OpenCV's threads are not to be forked
    return root


def _write(root: Path) -> None:
    time = np.arange(ROWS) / 10
    columns = {"time": time, "x": np.sin(time), "y": np.cos(time)}
    write_csv(root / "table.csv", **columns)
    parquet.write_table(pa.table(columns), root / "table.parquet")
    write_csv(root / "stamps.csv", time=time)
    write_video(root / "run.mkv", ROWS)
    write_images(root / "images", [f"{k / 10:.1f}.png" for k in range(ROWS)])


def read(root: Path, *, camera: str = "", table: str = "table.csv", replay: Any = None, **options: Any) -> TensorDict:
    """All rows, as a user reads them."""
    streams: dict[str, Any] = {"state": Table(root / table, **options)}
    if camera == "video":
        streams["camera"] = Video(root / "run.mkv", times=root / "stamps.csv")
    elif camera:
        streams["camera"] = Images(root / "images")
    settings = {"size": SIZE, "cache": None, "split": "all", "progress": False, **(replay or {})}
    return RecordingReplay(Recording(**streams), **settings)[:]


OWN = Folder("recordings", sound, read)


def _shown(result: TensorDict, camera: str = "images") -> bool:
    """Right where each row that counts as seen shows its own picture, and all numbers are as without damage."""
    expected = OWN.reference(camera=camera)
    if same(result, expected):
        return True
    found, places = leaves(result), result["time"].squeeze(-1)
    rows = [int((expected["time"].squeeze(-1) - time).abs().argmin()) for time in places]
    seen, sound_leaves = found["observed"].squeeze(-1), leaves(expected)
    numbers = {"state", "state_observed"} & set(found)
    equal = all(bool((found[key] == sound_leaves[key][rows]).all()) for key in numbers)
    pictures = bool((found["pixels"][seen] == expected["pixels"][rows][seen]).all())
    black = not bool(found["pixels"][~seen].any())
    return finite(result) and equal and pictures and black and len(result) >= ROWS - 2


# ------------------------------------------------------------------------------------------------------------ tables


TIMES = {"back": "0.05", "the same": "0.3", "an hour on": "3600.4", "1e300": "1e300", "negative": "-3"}
FIFTH: dict[str, Any] = {
    "an open quote": lambda row: ['"' + row[0], *row[1:]],
    "a line of a megabyte": lambda row: ["9" * (1 << 20)],
    "an empty line": lambda row: ["\n" + row[0], *row[1:]],
}
TABLES: dict[str, d.Change] = {
    "no header": lambda rows: rows[1:],
    "only a header": lambda rows: rows[:1],
    "one row": lambda rows: rows[:2],
    "an empty name": d.put((0, 1), ""),
    "no time": d.put((0, 0), "u"),
    "sorted backwards": lambda rows: [rows[0], *rows[:0:-1]],
    **{what: d.put((5,), change) for what, change in FIFTH.items()},
}


def _tables() -> Iterator[Target]:
    parquet_file, named = "table.parquet", {"table": "table.parquet"}
    yield OWN.target("table.csv", d.FILE, file="table.csv", rights={"cut by a byte": OWN.equal})
    yield OWN.target(parquet_file, d.BYTES.but().each(d.written), OWN.equal, file=parquet_file, options=named)
    yield OWN.target(f"{parquet_file} in its place", d.PLACES, file=parquet_file, options=named)
    names = lambda place: place[0] == 0 or len(place) == 1  # noqa: E731  # names, and rows that may be missing
    yield from OWN.document("table.csv", None, ("table",), skip=names, but=("--1",))
    yield from OWN.document(parquet_file, None, ("table",), skip=lambda place: len(place) < 2, options=named)
    times = d.Wrong(TIMES).each(lambda value: edited(d.put((5, 0), value)))
    # An hour's gap in a table is one: readings are as they stand there.
    yield OWN.target("time goes on by", times, file="table.csv", rights={"an hour on": finite})
    rights = dict.fromkeys(("an empty name", "an empty line"), OWN.equal)  # a column is a column
    lines = d.Wrong(TABLES).each(edited)
    yield OWN.target("table.csv's lines", lines, None, ("table.csv", "table"), "table.csv", rights=rights)


def _renamed(name: str) -> d.Change:
    return lambda file: file.rename(file.with_name(name))


IMAGES = {
    "a name that is no time": _renamed("half.png"),
    "a name that is nan": _renamed("nan.png"),
    "a name that is inf": _renamed("inf.png"),
    "a time twice": lambda file: file.with_name("0.50.png").write_bytes(file.read_bytes()),
    "a frame twice": lambda file: file.with_suffix(".jpg").write_bytes(file.read_bytes()),
    "a pipe": lambda file: os.mkfifo(file.with_name("0.55.png")),
    "a link to nowhere": lambda file: file.with_name("0.55.png").symlink_to("nowhere"),
    "no folder": lambda file: gone(file.parent),
    "no images": lambda file: [gone(one) for one in file.parent.iterdir()],
}


NAMES = {"in Latin-1": b"caf\xe9.mkv", "a byte": b"\xff.mkv", "a surrogate": b"\xed\xa0\x80.mkv"}


def _named(name: bytes, folder: Path) -> Any:
    """Reads a video of this name; a crash of OpenCV ends the process."""
    file = folder / os.fsdecode(name)
    shutil.copy(sound() / "run.mkv", file)
    return Video(file).read(SIZE, None, False)


def _pictures() -> Iterator[Target]:
    video, images = {"camera": "video"}, {"camera": "images"}
    # A video has no checksum: of a flipped byte a picture may be wrong, and nothing can tell.
    flips = [what for what in d.BYTES.named if "flipped" in what]
    cut = d.BYTES.but(*flips).each(d.written)
    ends = {"cut by a byte": partial(OWN.equal, camera="video")}
    yield OWN.target("video", cut, partial(_shown, camera="video"), ("run.mkv", "stamps.csv"), "run.mkv", video)
    yield OWN.target("video in its place", d.PLACES, None, ("run.mkv", "/dev/zero"), "run.mkv", video)
    yield OWN.target("video's stamps", d.FILE, None, "stamps.csv", "stamps.csv", video, rights=ends)
    words = ("images", "0.5.png", "half.png", "nan.png", "inf.png", "0.50.png", "0.5.jpg", "0.55.png")
    yield Target("recordings", "a video's name", ("name",), _named, d.Wrong(NAMES), needs=sound)
    one = d.SEALED.each(d.written) | d.PLACES
    yield OWN.target("image", one, _shown, words, "images/0.5.png", images)
    yield OWN.target("images", IMAGES, None, words, "images/0.5.png", images)


# --------------------------------------------------------------------------------------------------------- arguments

TABLE = {
    "columns": d.of(["z"], "x", [], 3),
    "time": d.of("stamp", 3),
    "unit": d.of("h", 3),
    "sample": d.of("first", 3),
    "tolerance": d.POSITIVE.but("inf"),
}
REPLAY = {
    "clock": d.of(0.0, -1.0, NAN, INF, "sun", 1e12),
    "size": d.SIZE | {"fractions": (1.5, 2.5)},
    "test_share": d.SHARE.but("inf"),
    "batch_size": d.COUNT_OR_NONE,
    "slice_len": d.COUNT.but("fraction"),
}
MADE: dict[str, tuple[tuple[str, ...], Callable[[], Any]]] = {
    "no streams": (("streams",), lambda: Recording()),
    "a stream of text": (("state",), lambda: Recording(state="table.csv")),
    "two cameras": (("camera",), lambda: Recording(a=Images("a", rate=1.0), b=Images("b", rate=1.0))),
    "a name that is taken": (("reward",), lambda: Recording(reward=Table("table.csv"))),
    "a name that is no text": (("name",), lambda: Recording(name=3, state=Table("table.csv"))),
    "no recordings": (("recordings",), lambda: RecordingReplay([])),
    "recordings of text": (("Recording",), lambda: RecordingReplay(["table.csv"])),
}


def _replayed(**given: Any) -> Any:
    return read(sound(), replay=given)


def _images(**given: Any) -> Any:
    return Images(sound() / "images", **given)


def _rows(change: Callable[[TensorDict], Any] = lambda rows: None, fps: Any = 10.0) -> Any:
    """Rows that are in memory."""
    state = torch.rand(12, 2, generator=torch.Generator().manual_seed(0))
    made = TensorDict({"observation": {"image": torch.zeros(12, 3, 8, 8, dtype=torch.uint8), "state": state}}, [12])
    made["episode"] = torch.arange(3).repeat_interleave(4)
    change(made)
    return LeRobotReplay(recording_from_rows(made, fps=fps), split="all")[:]


def _row_masked(result: TensorDict) -> bool:
    """Right where the damaged row counts neither as seen nor in a loss, and all others are as without damage."""
    masks = ("observed", "state_observed", ("collector", "mask"))
    return all(not bool(result[mask][1].any()) for mask in masks) and kept(result, _rows())


IN_MEMORY = {
    ("observation", "state"): {"nan": lambda state: state.flatten().index_fill(0, torch.tensor(3), NAN).view(12, 2)},
    ("observation", "image"): {
        "of two dimensions": lambda image: image[:, 0, 0],
        "of five channels": lambda image: image[:, :1].expand(12, 5, 8, 8).clone(),
    },
    ("episode",): {
        "as floats with nan": lambda episode: episode * NAN,
        "in two parts": lambda episode: episode.index_fill(0, torch.tensor([10, 11]), 0),
    },
}


def _trajectory(**given: Any) -> Any:
    """A path that is written for other programs."""
    layout = {"layout": "tum"} if "times" in given else {}
    return write_trajectory("path.txt", **{"trajectory": torch.zeros(5, 3), **layout, **given})


TRAJECTORY = {
    "trajectory": d.of(torch.full((5, 3), NAN), torch.zeros(5, 2), torch.zeros(5), "path"),
    "layout": d.of("csv"),
    "times": d.of(None, torch.zeros(3), torch.full((5,), NAN), torch.arange(5.0).flip(0)),
}


def targets() -> Iterator[Target]:
    """All of a recording, and the arguments of what reads it."""
    yield from _tables()
    yield from _pictures()
    table = dict.fromkeys(TABLE, ("table.csv",))
    rows = {"clock": ("rows", "slices"), "slice_len": ("rows", "slices")}
    images = {"start": d.FINITE, "rate": d.POSITIVE.but("inf")}
    yield from targets_of(
        "recordings",
        OWN.arguments("Table", wrong=TABLE, also=table),
        Subject(_replayed, wrong=REPLAY, also=rows, name="RecordingReplay"),
        Subject(_images, wrong=images, name="Images"),
        Subject(_rows, wrong={"fps": d.POSITIVE}, name="recording_from_rows"),
        Subject(_trajectory, wrong=TRAJECTORY, name="write_trajectory"),
    )
    act = lambda change, folder: _rows(change)  # noqa: E731
    right = {"observation/state nan": _row_masked}
    for path, changes in IN_MEMORY.items():
        wrong, word = d.fields({path: d.Wrong(changes)}), path[-1]
        yield Target("recordings", f"recording_from_rows: {word}", (word,), act, wrong, rights=right)
    for what, (words, make) in MADE.items():
        yield Target("recordings", what, words, lambda make, folder: make(), d.Wrong({"made": make}))
