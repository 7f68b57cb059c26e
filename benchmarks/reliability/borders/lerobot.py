"""Recordings in LeRobot's layout."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as parquet
import torch
from tensordict import TensorDict

from benchmarks.reliability.case import Case, apart, workshop
from benchmarks.reliability.damage import BYTES, copied, finite, gone, leaves, same, same_but, written
from tests.data.lerobot.lerobot_folder import SIZE, write_version_2, write_version_3
from torch_denkf.data import LeRobotReplay

LENGTHS = [6, 5, 7]
ROW = 8  # of the data set: row 2 of the second episode
INFO, EPISODES = "meta/info.json", "meta/episodes.jsonl"
DATA = "data/chunk-000/episode_000001.parquet"
CAMERA = "observation.images.top"
NAN, INF = float("nan"), float("inf")
Change = Callable[[Path], Any]


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


@cache
def reference(version: int) -> TensorDict:
    """The rows without damage."""
    return read(sound(version))


def _act(version: int, change: Change, folder: Path, **options: Any) -> TensorDict:
    root = copied(sound(version), folder)
    change(root)
    return read(root, **options)


def _equal(version: int, result: TensorDict) -> bool:
    return same(result, reference(version))


def _masked(rows: list[int], version: int, result: TensorDict) -> bool:
    """Right where the rows are as without damage, or those that are damaged are marked."""
    masks = [key for key, value in leaves(result).items() if value.dtype == torch.bool and "observed" in key]
    return _equal(version, result) or same_but(result, reference(version), rows, masks)


# ----------------------------------------------------------------------------------------------------------- metadata


def info(change: Callable[[dict], Any]) -> Change:
    """Changes the metadata."""

    def act(root: Path) -> None:
        content = json.loads((root / INFO).read_text())
        change(content)
        (root / INFO).write_text(json.dumps(content))

    return act


def _set(*path: str, value: Any) -> Change:
    def change(content: dict) -> None:
        for name in path[:-1]:
            content = content[name]
        content[path[-1]] = value

    return info(change)


def _drop(*path: str) -> Change:
    def change(content: dict) -> None:
        for name in path[:-1]:
            content = content[name]
        del content[path[-1]]

    return info(change)


HOSTILE_PATHS = {
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
FIELDS: dict[tuple[str, ...], dict[str, Any]] = {
    ("codebase_version",): {"unknown": "v9.0", "a number": 2.1, "nothing": None, "a list": ["v2.1"]},
    ("fps",): {"zero": 0, "negative": -10, "nan": NAN, "inf": INF, "text": "fast", "nothing": None, "a list": [10]},
    ("chunks_size",): {"zero": 0, "negative": -1, "text": "x", "nothing": None, "a fraction": 0.5, "nan": NAN},
    ("data_path",): HOSTILE_PATHS,
    ("features",): {"empty": {}, "a list": [], "nothing": None, "text": "x"},
    ("features", "observation.state"): {"empty": {}, "nothing": None, "text": "x"},
    ("features", "observation.state", "shape"): {
        "empty": [],
        "zero": [0],
        "negative": [-3],
        "another width": [4],
        "text": ["x"],
        "nothing": None,
        "a matrix": [3, 3],
        "huge": [10**12],
    },
    ("features", "observation.state", "dtype"): {"text": "string", "a number": 3, "nothing": None},
    ("features", CAMERA): {"empty": {}, "nothing": None, "text": "x"},
    ("features", CAMERA, "dtype"): {"unknown": "smell", "nothing": None},
}


def _metadata() -> Iterator[Case]:
    for what, change in BYTES.items():
        for file in (INFO, EPISODES):
            act = partial(_act, 2, lambda root, file=file, change=change: written(root / file, change))
            right = partial(_equal, 2) if what == "cut by a byte" and file == EPISODES else None
            yield Case("lerobot", f"{file} {what}", (Path(file).name,), act, right)
        act = partial(
            _act, 3, lambda root, change=change: written(root / "meta/episodes/chunk-000/file-000.parquet", change)
        )
        yield Case("lerobot", f"episodes of version 3 {what}", ("file-000.parquet",), act, partial(_equal, 3))
    for path, values in FIELDS.items():
        words = (*path, Path(INFO).name, "episode_000002.parquet")
        for what, value in values.items():
            right = partial(_equal, 2) if path[-1] == "dtype" else None
            act = partial(_act, 2, _set(*path, value=value))
            yield Case("lerobot", f"info.json {'/'.join(path)}: {what}", words, act, right)
        right = partial(_equal, 2) if path[0] == "chunks_size" else None
        yield Case("lerobot", f"info.json without {'/'.join(path)}", words, partial(_act, 2, _drop(*path)), right)
    for what, value in HOSTILE_PATHS.items():
        value = (
            value.replace("episode_index", "file_index").replace("episode_chunk", "chunk_index")
            if isinstance(value, str)
            else value
        )
        yield Case(
            "lerobot",
            f"info.json video_path: {what}",
            ("video_path", "info.json"),
            partial(_act, 3, _set("video_path", value=value)),
        )
    for file in (INFO, EPISODES, DATA):
        yield Case(
            "lerobot",
            f"{file} taken away",
            (Path(file).name,),
            partial(_act, 2, lambda root, file=file: gone(root / file)),
        )
    for what, change in (
        ("no root", gone),
        ("no data", lambda root: gone(root / "data")),
        ("no meta", lambda root: gone(root / "meta")),
    ):
        yield Case("lerobot", what, ("info.json", "data", "meta"), partial(_act, 2, change))


def _line(change: Callable[[dict], Any]) -> Change:
    def act(root: Path) -> None:
        lines = [json.loads(line) for line in (root / EPISODES).read_text().splitlines()]
        changed = change(lines[1])
        lines[1] = lines[1] if changed is None else changed
        (root / EPISODES).write_text("\n".join(map(json.dumps, lines)) + "\n")

    return act


def _episodes() -> Iterator[Case]:
    lines: dict[str, Callable[[dict], Any]] = {
        "a list": lambda line: [],
        "a number": lambda line: 3,
        "a text": lambda line: "x",
    }
    for key in ("episode_index", "length"):
        lines[f"without {key}"] = lambda line, key=key: line.pop(key) and None
        for what, value in {
            "text": "x",
            "nothing": None,
            "negative": -2,
            "huge": 10**12,
            "a fraction": 1.5,
            "nan": NAN,
            "one more": None,
        }.items():
            if what == "one more":
                lines[f"{key} one more"] = lambda line, key=key: line.update({key: line[key] + 1})
            else:
                lines[f"{key} {what}"] = lambda line, key=key, value=value: line.update({key: value})
    lines["the same episode twice"] = lambda line: line.update(episode_index=0, length=LENGTHS[0])
    for what, change in lines.items():
        words = ("episodes.jsonl", "episode_000001.parquet", "episode_000002.parquet", "episode_1000000000000.parquet")
        yield Case("lerobot", f"episodes.jsonl {what}", words, partial(_act, 2, _line(change)))
    columns = {"from_timestamp": (NAN, -5.0, 1e9, INF), "chunk_index": (-1, 10**9), "file_index": (-1, 10**9)}
    for name, values in columns.items():
        for value in values:
            act = partial(_act, 3, _episode_column(f"videos/{CAMERA}/{name}", value))
            words = (
                "file-000.parquet",
                "file-000.mkv",
                name,
                f"chunk-{value:03d}" if isinstance(value, int) else name,
                "file--01.mkv",
                "file-1000000000.mkv",
            )
            yield Case("lerobot", f"version 3, {name} {value}", words, act)


def _episode_column(name: str, value: Any) -> Change:
    def act(root: Path) -> None:
        file = root / "meta/episodes/chunk-000/file-000.parquet"
        rows = parquet.read_table(file).to_pylist()
        rows[1][name] = value
        parquet.write_table(pa.Table.from_pylist(rows), file)

    return act


# ---------------------------------------------------------------------------------------------------------------- data


def _table(change: Callable[[dict[str, list]], Any]) -> Change:
    """Changes the columns of the second episode."""

    def act(root: Path) -> None:
        table = parquet.read_table(root / DATA)
        columns = {name: table[name].to_pylist() for name in table.column_names}
        change(columns)
        types = {name: table[name].type for name in table.column_names}
        arrays = {}
        for name, values in columns.items():
            try:
                arrays[name] = pa.array(values, types.get(name))
            except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError):
                arrays[name] = pa.array(values)
        parquet.write_table(pa.table(arrays), root / DATA)

    return act


def _cell(name: str, value: Any) -> Change:
    def change(columns: dict[str, list]) -> None:
        cell = columns[name][2]
        columns[name][2] = [value, *cell[1:]] if isinstance(cell, list) else value

    return _table(change)


def _column(name: str, values: Callable[[list], list]) -> Change:
    return _table(lambda columns: columns.update({name: values(columns[name])}))


def _picture(value: Any) -> Change:
    def change(columns: dict[str, list]) -> None:
        columns[CAMERA][2] = value(columns[CAMERA][2])

    return _table(change)


def _bomb(cell: dict) -> dict:
    data = bytearray(cell["bytes"])
    data[16:24] = struct.pack(">II", 60000, 60000)
    return {"bytes": bytes(data), "path": None}


def _data() -> Iterator[Case]:
    words = ("episode_000001.parquet", "episode 1")
    for what, change in BYTES.items():
        act = partial(_act, 2, lambda root, change=change: written(root / DATA, change))
        yield Case("lerobot", f"data {what}", words, act, partial(_masked, [ROW], 2))
    masked = partial(_masked, [ROW], 2)
    for key in ("observation.state", "action"):
        for what, value in {"nan": NAN, "inf": INF, "1e38": 1e38, "null": None}.items():
            if what == "1e38":
                continue
            yield Case("lerobot", f"{key} {what}", (*words, key), partial(_act, 2, _cell(key, value)), masked)
        yield Case(
            "lerobot",
            f"{key} of another width in a row",
            (*words, key),
            partial(_act, 2, _column(key, lambda v: [*v[:2], v[2][:1], *v[3:]])),
            masked,
        )
        yield Case("lerobot", f"{key} of text", (*words, key), partial(_act, 2, _column(key, lambda v: ["x"] * len(v))))
        yield Case(
            "lerobot", f"{key} taken away", (*words, key), partial(_act, 2, _table(lambda c, key=key: c.pop(key)))
        )
        yield Case(
            "lerobot",
            f"{key} all nan",
            (*words, key),
            partial(_act, 2, _column(key, lambda v: [[NAN] * len(r) for r in v])),
            partial(_masked, list(range(6, 11)), 2),
        )
    stamps: dict[str, Callable[[list], list]] = {
        "all zero": lambda v: [0.0] * len(v),
        "nan": lambda v: [*v[:2], NAN, *v[3:]],
        "null": lambda v: [*v[:2], None, *v[3:]],
        "inf": lambda v: [*v[:2], INF, *v[3:]],
        "backwards": lambda v: v[::-1],
        "a repeated stamp": lambda v: [*v[:2], v[1], *v[3:]],
        "1e30": lambda v: [*v[:2], 1e30, *v[3:]],
        "text": lambda v: ["noon"] * len(v),
        "minus a day from the third on": lambda v: [*v[:2], *(x - 86400 for x in v[2:])],
    }
    for what, values in stamps.items():
        right = masked if what in ("a repeated stamp", "nan", "null", "inf", "1e30") else None
        yield Case(
            "lerobot", f"timestamp {what}", (*words, "timestamp"), partial(_act, 2, _column("timestamp", values)), right
        )
    for key in ("frame_index", "episode_index"):
        for what, values in {
            "all zero": lambda v: [0] * len(v),
            "null": lambda v: [*v[:2], None, *v[3:]],
            "text": lambda v: ["x"] * len(v),
            "backwards": lambda v: v[::-1],
            "nan": lambda v: [NAN, *map(float, v[1:])],
        }.items():
            if key == "episode_index" and what == "backwards":
                continue
            yield Case("lerobot", f"{key} {what}", (*words, key), partial(_act, 2, _column(key, values)))
    yield Case("lerobot", "a row less", words, partial(_act, 2, _table(lambda c: [v.pop() for v in c.values()])))
    yield Case(
        "lerobot", "a row more", words, partial(_act, 2, _table(lambda c: [v.append(v[-1]) for v in c.values()]))
    )
    pictures: dict[str, Any] = {
        "null": lambda cell: None,
        "no bytes": lambda cell: {"bytes": b"", "path": None},
        "cut": lambda cell: {"bytes": cell["bytes"][:40], "path": None},
        "cut by a byte": lambda cell: {"bytes": cell["bytes"][:-1], "path": None},
        "other bytes": lambda cell: {"bytes": b"nothing" * 10, "path": None},
        "a bomb": _bomb,
        "a path outside": lambda cell: {"bytes": None, "path": "../../../../../etc/passwd"},
        "an absolute path": lambda cell: {"bytes": None, "path": "/etc/passwd"},
        "a path to nowhere": lambda cell: {"bytes": None, "path": "images/nowhere.png"},
        "a device": lambda cell: {"bytes": None, "path": "/dev/zero"},
    }
    for what, value in pictures.items():
        yield Case("lerobot", f"picture {what}", (*words, CAMERA), partial(_act, 2, _picture(value)), masked)

    def planted(root: Path) -> None:
        (root.parent / "secret.png").write_bytes(parquet.read_table(root / DATA)[CAMERA][2].as_py()["bytes"])
        _picture(lambda cell: {"bytes": None, "path": "../secret.png"})(root)

    yield Case(
        "lerobot", "picture of a file outside that is there", (*words, "secret.png"), partial(_act, 2, planted), _hidden
    )
    video = f"videos/{CAMERA}/chunk-000/file-000.mkv"
    for what, change in BYTES.items():
        if "flipped" in what:  # a video has no checksum: a picture may be wrong, and nothing can tell
            continue
        act = partial(_act, 3, lambda root, change=change: written(root / video, change))
        yield Case("lerobot", f"video {what}", ("file-000.mkv",), act, _video)
    yield Case("lerobot", "video taken away", ("file-000.mkv",), partial(_act, 3, lambda root: gone(root / video)))
    yield Case(
        "lerobot",
        "video a link to a device",
        ("file-000.mkv",),
        partial(_act, 3, lambda root: (gone(root / video), (root / video).symlink_to("/dev/zero"))),
    )


def _hidden(result: TensorDict) -> bool:
    """Right where the picture counts as missing."""
    return same_but(result, reference(2), [ROW], ["observed"])


def _video(result: TensorDict) -> bool:
    """Right where every row that counts as seen shows its own picture, but for a codec's rounding."""
    expected = reference(3)
    seen = result["observed"].squeeze(-1)
    numbers = [key for key in expected.keys(True, True) if key != "pixels" and key != "observed"]
    equal = all(torch.equal(result[key], expected[key]) for key in numbers)
    off = (result["pixels"] - expected["pixels"])[seen].abs().flatten(1).mean(-1)
    return finite(result) and equal and bool((off < 0.02).all()) and not bool(result["pixels"][~seen].any())


ARGUMENTS: dict[str, dict[str, Any]] = {
    "camera": {"unknown": "bottom", "a number": 3, "outside": "../.."},
    "state_key": {"unknown": "nothing", "no vector": CAMERA, "a number": 3},
    "action_key": {"unknown": "nothing", "no vector": CAMERA},
    "size": {"zero": (0, 10), "negative": (-4, 4), "one number": (4,), "text": "ab", "fractions": (1.5, 2.5)},
}


def cases() -> Iterator[Case]:
    """All damaged recordings."""
    sound(2), sound(3)  # here, not in each case's process
    yield from _metadata()
    yield from _episodes()
    yield from _data()
    for name, values in ARGUMENTS.items():
        for what, value in values.items():
            act = partial(_act, 2, lambda root: None, **{name: value})
            words = (name, "camera") if name == "camera" else (name, "feature") if "key" in name else (name,)
            yield Case("lerobot", f"LeRobotReplay({name}: {what})", words, act)
