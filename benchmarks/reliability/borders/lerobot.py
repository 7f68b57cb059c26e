"""Recordings in LeRobot's layout."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as parquet
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders.kitti import bomb
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.damage import fields, finite, gone, in_lines, leaves, on_row, put, same, same_but
from benchmarks.reliability.target import Folder, Target, targets_of
from tests.data.lerobot.lerobot_folder import SIZE, write_version_2, write_version_3
from torch_denkf.data import LeRobotReplay

LENGTHS = [6, 5, 7]
ROW = 8  # of the data set: row 2 of the second episode
INFO, EPISODES = "meta/info.json", "meta/episodes.jsonl"
EPISODES_3 = "meta/episodes/chunk-000/file-000.parquet"
DATA = "data/chunk-000/episode_000001.parquet"
CAMERA = "observation.images.top"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mkv"
NAN, INF = float("nan"), float("inf")


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


def _equal_times(result: TensorDict) -> bool:
    """Right where times without stamps are those of the frames' numbers; stamps are rounded."""
    return same(result, V2.reference(), atol=1e-6)


def _masked(result: TensorDict, rows: tuple[int, ...] = (ROW,)) -> bool:
    """Right where the rows are as without damage, or those that are damaged are marked."""
    masks = [key for key, value in leaves(result).items() if value.dtype == torch.bool and "observed" in key]
    return V2.equal(result) or same_but(result, V2.reference(), rows, masks)


def _hidden(result: TensorDict) -> bool:
    """Right where the picture counts as missing."""
    return same_but(result, V2.reference(), [ROW], ["observed"])


def _shown(result: TensorDict) -> bool:
    """Right where every row that counts as seen shows its own picture, but for a codec's rounding."""
    expected = V3.reference()
    seen = result["observed"].squeeze(-1)
    numbers = [key for key in expected.keys(True, True) if key != "pixels" and key != "observed"]
    equal = all(torch.equal(result[key], expected[key]) for key in numbers)
    off = (result["pixels"] - expected["pixels"])[seen].abs().flatten(1).mean(-1)
    return finite(result) and equal and bool((off < 0.02).all()) and not bool(result["pixels"][~seen].any())


# ----------------------------------------------------------------------------------------------------------- metadata


def in_json(change: d.Change) -> d.Change:
    """Changes what is in a file of JSON."""

    def act(file: Path) -> None:
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))

    return act


def json_line(row: int, change: d.Change) -> d.Change:
    """Changes what is in a line of JSON, or puts another value there."""

    def act(text: str) -> str:
        content = json.loads(text)
        changed = change(content)
        return json.dumps(content if changed is None else changed)

    return in_lines(on_row(row, act))


PATHS = d.Wrong(
    {
        "outside": "../../../../{episode_chunk}{episode_index}.parquet",
        "absolute": "/etc/passwd",
        "another name": "data/{nothing}.parquet",
        "half a brace": "data/{",
        "an attribute": "data/{episode_index.__class__.__mro__}.parquet",
        "an index": "data/{episode_index[0]}.parquet",
        "a width of a billion": "data/{episode_index:01000000000d}.parquet",
        "a number": 3,
        "nothing": None,
        "a list": ["data"],
        "a zero byte": "data/\0.parquet",
    }
)
SHAPE = {"empty": [], "zero": [0], "negative": [-3], "another width": [4], "text": ["x"], "huge": [10**12]}
NO_FEATURE = d.types("nothing", "text", empty={})
STATE = ("features", "observation.state")
FIELDS = {
    ("codebase_version",): d.types("nothing", "a list", "a fraction", unknown="v9.0"),
    ("fps",): d.types("text", "nothing", "a list", "negative", zero=0, nan=NAN, inf=INF),
    ("chunks_size",): d.types("text", "nothing", "a fraction", "negative", zero=0, nan=NAN),
    ("data_path",): PATHS,
    ("features",): NO_FEATURE | d.types("a list"),
    STATE: NO_FEATURE,
    (*STATE, "shape"): d.Wrong({**SHAPE, "nothing": None, "a matrix": [3, 3]}),
    (*STATE, "dtype"): d.Wrong({"text": "string", "a number": 3, "nothing": None}),
    ("features", CAMERA): NO_FEATURE,
    ("features", CAMERA, "dtype"): d.Wrong({"unknown": "smell", "nothing": None}),
}


def _for_files(path: Any) -> Any:
    """The same path in the words of version 3."""
    renamed = isinstance(path, str)
    return path.replace("episode_index", "file_index").replace("episode_chunk", "chunk_index") if renamed else path


def _metadata() -> Iterator[Target]:
    yield V2.target("info.json", d.FILE, file=INFO)
    yield V2.target("episodes.jsonl", d.FILE, file=EPISODES, rights={"cut by a byte": V2.equal})
    yield V3.target("episodes of version 3", d.BYTES.but().each(d.written), V3.equal, file=EPISODES_3)
    for path, values in FIELDS.items():
        may_be = V2.equal if path[-1] == "dtype" else None
        wrong, words = fields({path: values}), (*path, "info.json", "episode_000002.parquet")
        less = {"chunks_size missing": V2.equal}
        yield V2.target(f"info.json, {'/'.join(path)}", wrong.each(in_json), may_be, words, INFO, rights=less)
    paths = fields({"video_path": PATHS.each(_for_files)}, missing=False).each(in_json)
    yield V3.target("info.json of version 3", paths, None, ("video_path", "info.json"), INFO)
    for name in ("", "data", "meta"):
        yield V2.one(f"no {name or 'root'}", gone, ("info.json", "data", "meta"), file=name)


INDEX = d.types("text", "nothing", "negative", "a fraction", huge=10**12, nan=NAN) | {"one more": lambda old: old + 1}
LINES = fields({"episode_index": INDEX, "length": INDEX}) | {
    "a list": lambda line: [],
    "a number": lambda line: 3,
    "a text": lambda line: "x",
    "the same episode twice": lambda line: line.update(episode_index=0, length=LENGTHS[0]),
}


def in_column(name: str, value: Any) -> d.Change:
    """Another value in a table of episodes."""

    def act(file: Path) -> None:
        rows = parquet.read_table(file).to_pylist()
        rows[1][name] = value
        parquet.write_table(pa.Table.from_pylist(rows), file)

    return act


def _episodes() -> Iterator[Target]:
    names = (EPISODES, DATA, "episode_000002.parquet", "episode_1000000000000.parquet")
    words = tuple(Path(name).name for name in names)
    yield V2.target("episodes.jsonl's line", LINES.each(partial(json_line, 1)), None, words, EPISODES)
    columns = {"from_timestamp": (NAN, -5.0, 1e9, INF), "chunk_index": (-1, 10**9), "file_index": (-1, 10**9)}
    for name, values in columns.items():
        words = ("file-000.parquet", "file-000.mkv", name, "file--01.mkv", "file-1000000000.mkv")
        words += ("chunk--01", "chunk-1000000000") if name != "from_timestamp" else ()
        wrong = d.Wrong({str(value): in_column(f"videos/{CAMERA}/{name}", value) for value in values})
        yield V3.target(f"version 3, {name}", wrong, None, words, EPISODES_3)


# ---------------------------------------------------------------------------------------------------------------- data


def in_table(change: d.Change) -> d.Change:
    """Changes the columns of a table."""

    def act(file: Path) -> None:
        table = parquet.read_table(file)
        columns = {name: table[name].to_pylist() for name in table.column_names}
        change(columns)
        types = {name: table[name].type for name in table.column_names}
        arrays = {}
        for name, values in columns.items():
            try:
                arrays[name] = pa.array(values, types.get(name))
            except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError):
                arrays[name] = pa.array(values)
        parquet.write_table(pa.table(arrays), file)

    return act


def of_cell(cell: Callable[[Any], Any]) -> Callable[[list], list]:
    """Changes the third value of a column."""
    return on_row(2, cell)


def _all(value: Any) -> Callable[[list], list]:
    return lambda column: [value] * len(column)


CELL = {
    "nan": of_cell(lambda cell: [NAN, *cell[1:]]),
    "inf": of_cell(lambda cell: [INF, *cell[1:]]),
    "null": of_cell(lambda cell: [None, *cell[1:]]),
    "of another width in a row": of_cell(lambda cell: cell[:1]),
}
VECTORS = d.Wrong({**CELL, "of text": _all("x"), "all nan": lambda column: [[NAN] * len(cell) for cell in column]})
STAMPS = {
    "nan": of_cell(lambda stamp: NAN),
    "null": of_cell(lambda stamp: None),
    "inf": of_cell(lambda stamp: INF),
    "1e30": of_cell(lambda stamp: 1e30),
    "a repeated stamp": lambda column: [*column[:2], column[1], *column[3:]],
}
NO_STAMPS = {
    "all zero": _all(0.0),
    "backwards": lambda column: column[::-1],
    "text": _all("noon"),
    "minus a day from the third on": lambda column: [*column[:2], *(stamp - 86400 for stamp in column[2:])],
}
NUMBERS = d.Wrong(
    {
        "all zero": _all(0),
        "null": of_cell(lambda index: None),
        "text": _all("x"),
        "nan": lambda column: [NAN, *map(float, column[1:])],
        "backwards": lambda column: column[::-1],
    }
)
PICTURES = {
    "null": lambda cell: None,
    "no bytes": lambda cell: {"bytes": b"", "path": None},
    "cut": lambda cell: {"bytes": cell["bytes"][:40], "path": None},
    "cut by a byte": lambda cell: {"bytes": cell["bytes"][:-1], "path": None},
    "other bytes": lambda cell: {"bytes": b"nothing" * 10, "path": None},
    "a bomb": lambda cell: {"bytes": bomb(cell["bytes"]), "path": None},
    "a path outside": lambda cell: {"bytes": None, "path": "../../../../../etc/passwd"},
    "an absolute path": lambda cell: {"bytes": None, "path": "/etc/passwd"},
    "a path to nowhere": lambda cell: {"bytes": None, "path": "images/nowhere.png"},
    "a device": lambda cell: {"bytes": None, "path": "/dev/zero"},
}


def _planted(file: Path) -> None:
    """A picture outside the data set that is there."""
    root = file.parents[2]
    (root.parent / "secret.png").write_bytes(parquet.read_table(file)[CAMERA][2].as_py()["bytes"])
    cell = {"bytes": None, "path": "../secret.png"}
    in_table(put((CAMERA,), of_cell(lambda old: cell)))(file)


def _data() -> Iterator[Target]:
    words = ("episode_000001.parquet", "episode 1")
    yield V2.target("data", d.FILE.but(), _masked, words, DATA)

    def column(key: str, wrong: d.Wrong | dict[str, Any], right: Any = None, **more: Any) -> Target:
        wrong = wrong if isinstance(wrong, d.Wrong) else d.Wrong(wrong)
        changes = fields({key: wrong}).each(in_table)
        return V2.target(f"column {key}", changes, right, (*words, key), DATA, **more)

    for key in ("observation.state", "action"):
        rights = {f"{key} {what}": _masked for what in CELL}
        rights[f"{key} all nan"] = partial(_masked, rows=tuple(range(6, 11)))
        yield column(key, VECTORS, rights=rights)
    stamps = {f"timestamp {what}": _masked for what in STAMPS} | {"timestamp missing": _equal_times}
    yield column("timestamp", {**STAMPS, **NO_STAMPS}, rights=stamps)
    # What is not there, nothing is compared with.
    yield column("frame_index", NUMBERS, rights={"frame_index missing": V2.equal})
    yield column("episode_index", NUMBERS.but("backwards"))
    picture = fields({CAMERA: d.Wrong(PICTURES).each(of_cell)}, missing=False).each(in_table)
    yield V2.target("picture", picture, _masked, (*words, CAMERA), DATA)
    rows = {
        "a row less": lambda columns: [column.pop() for column in columns.values()],
        "a row more": lambda columns: [column.append(column[-1]) for column in columns.values()],
    }
    yield V2.target("rows", d.Wrong(rows).each(in_table), None, words, DATA)
    yield V2.one("picture of a file outside that is there", _planted, (*words, "secret.png"), file=DATA, right=_hidden)
    # A video has no checksum: of a flipped byte a picture may be wrong, and nothing can tell.
    flips = [what for what in d.BYTES.named if "flipped" in what]
    yield V3.target("video", d.BYTES.but(*flips).each(d.written), _shown, file=VIDEO)
    yield V3.target("video in its place", d.PLACES, file=VIDEO)


ARGUMENTS = {
    "camera": d.Wrong({"unknown": "bottom", "a number": 3, "outside": "../.."}),
    "state_key": d.Wrong({"unknown": "nothing", "no vector": CAMERA, "a number": 3}),
    "action_key": d.Wrong({"unknown": "nothing", "no vector": CAMERA}),
    "size": d.SIZE | {"fractions": (1.5, 2.5)},
}
ALSO = {"state_key": ("feature",), "action_key": ("feature",)}


def targets() -> Iterator[Target]:
    """All of a recording, and the arguments of what reads it."""
    yield from _metadata()
    yield from _episodes()
    yield from _data()
    yield from targets_of("lerobot", V2.arguments("LeRobotReplay", wrong=ARGUMENTS, also=ALSO))
