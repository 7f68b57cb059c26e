"""Files of recordings and their caches: KITTI's drives, LeRobot's episodes, UR5 demos, tables and videos, corners."""

from __future__ import annotations

import hashlib
import os
import shutil
import struct
import warnings
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import torch
from tensordict import NonTensorData, TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.damage import NAN, gone, instead, kept, put, renamed, same, spoiled, written
from benchmarks.reliability.documents import edited
from benchmarks.reliability.hostile import MARK, Bomb, archive, npz_of_zeros
from benchmarks.reliability.target import Source, Target
from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from tests.data.lerobot.lerobot_folder import SIZE as SMALL
from tests.data.lerobot.lerobot_folder import write_version_2, write_version_3
from tests.data.recordings.own_files import write_csv, write_images, write_video
from torch_denkf.applications.car import read_kitti_drive, with_motion, write_drives
from torch_denkf.applications.car.corners.drive import corner_replay, read_corner_drive
from torch_denkf.applications.car.corners.motion import corner_motion
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.data import Images, LeRobotReplay, Recording, RecordingReplay, Table, Video
from torch_denkf.data.lerobot.rows import recording_from_rows

ALL_ROWS = {"split": "all", "cache": None, "progress": False}


def made(name: str, write: Callable[[Path], Any]) -> Callable[[], Path]:
    """Returns what makes a folder, once, in a process of its own: OpenCV's threads are not to be forked."""

    @cache
    def make() -> Path:
        root = workshop() / name
        root.mkdir()
        apart(lambda: write(root))
        return root

    return make


def one_row(place: tuple[Any, ...]) -> bool:
    """Tells whether a place is a whole row: without it, the others are sound."""
    return len(place) == 1


# ------------------------------------------------------------------------------------------------------------- KITTI

DRIVE, FRAMES, SIZE = "town", 10, (24, 72)
POSE_FILE, SEQUENCE = f"poses/{DRIVE}.txt", f"sequences/{DRIVE}"
IMAGES, TIME_FILE, CALIBRATION_FILE = f"{SEQUENCE}/image_2", f"{SEQUENCE}/times.txt", f"{SEQUENCE}/calib.txt"


def read_drive(root: Path, drive: Any = DRIVE, **options: Any) -> TensorDict:
    """Returns a drive, as a user reads it."""
    return read_kitti_drive(root, drive, **{"size": SIZE, "cache": None, **options})


drives = made("kitti", lambda root: write_drives(root, [DRIVE], frames=FRAMES, size=SIZE))
KITTI = Source("kitti", drives, read_drive)


def _equal_so_far(result: TensorDict) -> bool:
    return len(result) > 0 and same(result, KITTI.reference()[: len(result)])


def _that_picture(result: TensorDict) -> bool:
    """A picture is read by what it holds, whatever its name ends in: this one is of one grey."""
    picture = result["image"][4].flatten()
    return bool((picture == picture[0]).all() and result["frame_valid"].all())


def _times_masked(result: TensorDict) -> bool:
    """Tells whether poses and pictures are as without damage, and frames of a wrong time are marked as missing.

    A first time that is too early is a gap, after which no motion is known.
    """
    expected, seen = KITTI.reference(), result["frame_valid"].squeeze(-1)
    gap = bool((result["time"].diff(dim=0) > 10).any())
    poses = len(result) == FRAMES and torch.equal(result["state"][:, :3], expected["state"][:, :3])
    pictures = poses and torch.equal(result["image"][seen], expected["image"][seen])
    return d.finite(result) and pictures and (not bool(seen.all()) or gap)


def _times_as_told(result: TensorDict) -> bool:
    """Without stamps, frames come ten times a second, and all that needs no time is as it was."""
    expected = KITTI.reference()
    return same(result["state"][:, :3], expected["state"][:, :3]) and same(result["image"], expected["image"])


def _picture(size: tuple[int, int], suffix: str) -> d.Change:
    return lambda file: file.write_bytes(cv2.imencode(suffix, np.full((*size, 3), 7, np.uint8))[1].tobytes())


def bomb(data: bytes) -> bytes:
    """Returns a picture that says that it is of 60,000 x 60,000 pixels."""
    return data[:16] + struct.pack(">II", 60000, 60000) + data[24:]


NAMES = ("0004.png", "-00004.png", "000004.PNG", "000999.png", "9" * 30 + ".png")
PICTURES = (
    d.SEALED | d.PLACES | d.of(*NAMES).each(renamed) | {"a JPEG": _picture(SIZE, ".jpg"), "a bomb": written(bomb)}
)
NO_PICTURES = {
    "another size": _picture((10, 10), ".png"),
    "the same number twice": lambda file: shutil.copy(file.with_name("000003.png"), file.with_name("4.png")),
}
POSES: dict[str, d.Change] = {
    "a comment": lambda line: ["#", *line],
    "thirteen numbers": lambda line: [*line, "1"],
    "an empty line": lambda line: [],
    "no rotation": lambda line: ["0"] * 11 + line[11:],
    "mirrored": lambda line: ["-1", *line[1:]],
    "sheared": lambda line: [line[0], "0.2", *line[2:]],
    "1e200": lambda line: [*line[:11], "1e200"],
    "a jump of 1e9 m": lambda line: [*line[:3], "1e9", *line[4:]],
}
CALIBRATION = d.of((1, "0"), (1, "-700"), (6, "0"), (1, "1e300"), (0, "Q2:")).each(
    lambda one: edited(put((2, one[0]), one[1]))
)


def _of_kitti() -> Iterator[Target]:
    picture, names = f"{IMAGES}/000004.png", ("000004.png", "4.png", *NAMES)
    without_times = dict.fromkeys(d.NOTHING.named, _times_as_told)
    yield KITTI.target("poses", d.FILE, _equal_so_far, file=POSE_FILE)
    yield KITTI.target("times.txt", d.FILE, _equal_so_far, file=TIME_FILE, rights=without_times)
    yield KITTI.target("calib.txt", d.FILE, KITTI.like(), file=CALIBRATION_FILE)  # another row of it may be damaged
    yield from KITTI.document(POSE_FILE, skip=one_row)
    yield from KITTI.document(TIME_FILE, skip=one_row)
    yield from KITTI.document(CALIBRATION_FILE, KITTI.like(), skip=one_row, loose=lambda place: place[0] != 2)
    pose = d.Wrong(POSES).each(lambda change: edited(put(4, change)))
    time = d.of(["1e300"], ["-1e300"], [], ["0.1", "0.2"]).each(lambda line: edited(put(4, line)))
    yield KITTI.target("pose 4", pose, None, f"{DRIVE}.txt:5", POSE_FILE)
    yield KITTI.target("time 4", time, _times_masked, "times.txt:5", TIME_FILE)
    yield KITTI.target("calibration", CALIBRATION, file=CALIBRATION_FILE)
    masked = lambda result: kept(result, KITTI.reference())  # noqa: E731
    yield KITTI.target("picture", PICTURES, masked, names, picture, rights={"a JPEG": _that_picture})
    yield KITTI.target("picture of", NO_PICTURES, None, names, picture)
    emptied, without = (lambda folder: [file.write_bytes(b"") for file in folder.iterdir()]), d.instead(Path.mkdir)
    yield KITTI.target("all pictures empty", emptied, None, "image_2", IMAGES)
    yield KITTI.target("no pictures", without, None, ("image_2", DRIVE), IMAGES)
    for name, word in (("poses", f"{DRIVE}.txt"), (SEQUENCE, DRIVE), ("sequences", "sequences"), ("", "sequences")):
        yield KITTI.target(f"no folder {name}", gone, None, word, name)
    yield KITTI.target("a file as root", instead(Path.touch), None, "sequences")
    for key in ("image", "frame_valid", "calibration"):
        act = lambda key, folder: with_motion(KITTI.reference().exclude(key), cache=None)  # noqa: E731
        yield Target("kitti", f"with_motion without {key}", (key,), act, d.Wrong({"taken away": key}))


# ----------------------------------------------------------------------------------------------------------- LeRobot

LENGTHS = [6, 5, 7]
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
V3 = Source("lerobot", made("lerobot3", lambda root: write_version_3(root, [LENGTHS[:2], LENGTHS[2:]])), read_episodes)


def _rows_kept(result: TensorDict) -> bool:
    """Tells whether rows are as without damage, or those of the damaged episode are marked; stamps are rounded."""
    return kept(result, V2.reference(), most=LENGTHS[1], rtol=1e-6)


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
VECTORS = {"all nan": lambda column: [[NAN] * len(cell) for cell in column], "text": lambda column: ["x"] * 5}
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


def _of_lerobot() -> Iterator[Target]:
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
    yield V2.target("picture", cells, _rows_kept, (*words, CAMERA), DATA)
    yield V2.target("picture of a file outside that is there", _planted, _rows_kept, (*words, "secret.png"), DATA)
    yield V2.target("rows", d.Wrong(ROWS).each(edited), None, words, DATA)
    for name in ("", "data", "meta"):
        yield V2.target(f"no {name or 'root'}", gone, None, ("info.json", "data", "meta"), name)
    # A video has no checksum: of a flipped byte a picture may be wrong, and nothing can tell.
    yield V3.target("video", d.CUT, _video_shown, file=VIDEO)
    yield V3.target("video in its place", d.PLACES, file=VIDEO)


# --------------------------------------------------------------------------------------------------------------- UR5

DEMO, MANIFEST = "demo-000001.npz", "demos.jsonl"


def read_demos(root: Path, **options: Any) -> TensorDict:
    """Returns all rows, as a user reads them."""
    return UR5ExperienceReplay(root, **{**ALL_ROWS, **options})[:]


def _warned(root: Path) -> tuple[TensorDict, list[str]]:
    """Returns the rows, and what was said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = read_demos(root)
    return result, [str(warning.message) for warning in caught]


demos = made("ur5", lambda root: write_folder(root, [make_demo(number, rows) for number, rows in enumerate((6, 5, 7))]))
DEMOS = Source("ur5", demos, read_demos)
LISTED = Source("ur5", demos, _warned)


def _all_or_said(result: tuple[TensorDict, list[str]]) -> bool:
    """Tells whether all demos are there, or the first ones, and a warning names the list that lacks the others."""
    rows, said = result
    first = same(rows, DEMOS.reference()[: len(rows)])
    return DEMOS.like()(rows) or (first and any(MANIFEST in message for message in said))


def signed(change: d.Change) -> d.Change:
    """Changes a demo, and the manifest's checksum, as somebody with bad intentions would."""

    def act(file: Path) -> None:
        change(file)
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
        edited(put((1, "sha256"), sha256))(file.with_name(MANIFEST))

    return act


TEXTS = {
    "a line twice": lambda lines: [*lines, lines[1]],
    "one field more": put(1, lambda line: {**line, "colour": "red"}),
    "another demo": put((1, "demo"), 7),
    "another demo's file": put((1, "file"), "demo-000000.npz"),
    "one row more": put((1, "rows"), 6),
    "one frame more": put((1, "frames"), 4),
    "no checksum of this": put((1, "sha256"), "0" * 64),
}
ARRAYS = {
    "task juggle": put("task", np.array("juggle")),
    "domain moon": put("domain", np.array("moon")),
    "number 7": put("number", np.array(7)),
    "state 1e30": put("state", spoiled(0.5, 1e30)),
    "pixels as floats": put("pixels", lambda array: array / 255),
    "an array more": lambda arrays: {**arrays, "extra": np.zeros(3)},
    "steps beyond the rows": put("steps", lambda array: array + 100),
    "steps negative": put("steps", lambda array: array - 100),
    "steps the same twice": put("steps", lambda array: np.full_like(array, 2)),
    "steps not ascending": put("steps", lambda array: array[::-1].copy()),
}


def _of_ur5() -> Iterator[Target]:
    npz_of_zeros(1 << 30)  # here, not in each case's process
    words, lost = (MANIFEST, DEMO, "demo-000000.npz", "demo-000002.npz"), lambda place: place[-1] == "failures"
    yield LISTED.target("manifest", d.FILE, _all_or_said, file=MANIFEST)
    yield from DEMOS.document(MANIFEST, DEMOS.like(), words, skip=one_row, loose=lost)
    lines = d.Wrong(TEXTS).each(edited)
    yield DEMOS.target("manifest's lines", lines, None, words, MANIFEST, rights={"a line twice": DEMOS.like()})
    yield DEMOS.target("demo", d.SEALED | d.PLACES, file=DEMO)
    dated = d.BYTES.but().each(signed)  # nobody reads the date of an archive
    yield DEMOS.target("demo, checksum adapted", dated, DEMOS.like(), file=DEMO)
    yield from DEMOS.document(DEMO, then=signed)
    yield DEMOS.target("demo's arrays", d.Wrong(ARRAYS).each(edited).each(signed), file=DEMO)
    hostile = {
        "with a pickle that runs code": written(lambda data: Bomb.npz("state")),
        "of 20,000 arrays": archive({f"{number}.npy": b"" for number in range(20000)}),
        "that unpacks to a gigabyte": written(lambda data: npz_of_zeros(1 << 30)),
    }
    yield DEMOS.target("hostile demo", d.Wrong(hostile).each(signed), file=DEMO, within=4)
    yield DEMOS.target("no root", gone, None, "ur5")


# ----------------------------------------------------------------------------------------------- one's own recordings


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
    "an empty line": put((5, 0), "\n".__add__),
}
IMAGE_FILES = {
    **{f"a name that is {what}": renamed(f"{what}.png") for what in ("half", "nan", "inf")},
    "a time twice": lambda file: file.with_name("0.50.png").write_bytes(file.read_bytes()),
    "a frame twice": lambda file: file.with_suffix(".jpg").write_bytes(file.read_bytes()),
    "a pipe": lambda file: os.mkfifo(file.with_name("0.55.png")),
    "a link to nowhere": lambda file: file.with_name("0.55.png").symlink_to("nowhere"),
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


def _of_own() -> Iterator[Target]:
    parquet_file, named = "table.parquet", {"table": "table.parquet"}
    video, images, image = {"camera": "video"}, {"camera": "images"}, "images/0.5.png"
    yield OWN.target("table.csv", d.FILE, file="table.csv", rights={"cut by a byte": OWN.like()})
    yield OWN.target(parquet_file, d.BYTES.but(), OWN.like(), file=parquet_file, options=named)
    yield OWN.target(f"{parquet_file} in its place", d.PLACES, file=parquet_file, options=named)
    names = lambda place: place[0] == 0 or len(place) == 1  # noqa: E731  # names, and rows that may be missing
    yield from OWN.document("table.csv", None, ("table",), skip=names, but=("'--1'",))
    yield from OWN.document(parquet_file, None, ("table",), skip=one_row, options=named)
    # An hour's gap in a table is one: readings are as they stand there.
    times = TIMES.each(lambda value: edited(put((5, 0), value)))
    yield OWN.target("time goes on by", times, file="table.csv", rights={"an hour on": d.finite})
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


# ----------------------------------------------------------------------------------------------------------- corners


def sound_entries() -> dict[str, np.ndarray]:
    """Returns a drive of eight rows and six corners that all see."""
    random = np.random.default_rng(0)
    left = np.stack([600 + 100 * random.normal(size=(6, 8)), 180 + 20 * random.normal(size=(6, 8))])
    return {
        "features": np.concatenate([left, left - np.array([20.0, 0.0])[:, None, None]]),
        "K": np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]]),
        "b": np.array(0.54),
        "cam_T_imu": np.eye(4),
        "rotational_velocity": 0.1 * random.normal(size=(3, 8)),
        "time_stamps": np.arange(8)[None] / 10 + 1.3e9,
    }


#: Entries that are wrong, by what is: their name, and what becomes of them.
BAD_ENTRIES: dict[str, tuple[str, Callable[[np.ndarray], Any]]] = {
    "no corner seen": ("features", lambda array: np.full_like(array, -1)),
    "fewer rows of corners": ("rotational_velocity", lambda array: array[:, :5]),
    "left and right exchanged": ("features", lambda array: array[[2, 3, 0, 1]]),
    "corners below zero": ("features", spoiled((0, 0, 0), -30.0)),
    "corners of 1e9": ("features", spoiled((0, 0, 0), 1e9)),
    "a focal length of zero": ("K", spoiled((0, 0), 0.0)),
    "two focal lengths": ("K", spoiled((1, 1), 350.0)),
    "a skew": ("K", spoiled((0, 1), 30.0)),
    "no last row": ("K", spoiled((2, 2), 0.0)),
    "a baseline of zero": ("b", lambda array: 0.0),
    "a negative baseline": ("b", lambda array: -0.54),
    "a baseline in mm": ("b", lambda array: 540.0),
    "no rotation": ("cam_T_imu", lambda array: 2 * array),
    "a mirror": ("cam_T_imu", spoiled((0, 0), -1.0)),
    "rates in degrees": ("rotational_velocity", lambda array: 1000 * array),
    "stamps that stand": ("time_stamps", spoiled((0, 4), 1.3e9 + 0.3)),
    "stamps that go back": ("time_stamps", lambda array: array[:, ::-1]),
}


def read_corners(root: Path, **options: Any) -> Any:
    """Returns all rows, as a user replays them."""
    rows, camera = read_corner_drive(root / "drive.npz", **options)
    replay = corner_replay({"drive": rows.exclude("came_from")}, split="all", cache=None)[:]
    before, after = (camera.corners(rows["corners"][:, :, row]).float() for row in (0, 1))
    start = torch.tensor([1.0, *[0.0] * 6]).expand(len(rows), 7)
    return replay.set("motion", corner_motion(before, after, rows["seen"], camera, start=start, steps=2).motion)


CORNERS = Source("corners", made("corners", lambda root: np.savez(root / "drive.npz", **sound_entries())), read_corners)


def _of_corners() -> Iterator[Target]:
    file = "drive.npz"
    whole = d.SEALED.without("cut by a byte", "a byte flipped at 0.0")
    yield CORNERS.target(file, whole, CORNERS.like(), file=file)
    yield CORNERS.target(f"{file} in its place", d.PLACES, file=file, within=4)
    yield from CORNERS.document(file)
    for what, (name, change) in BAD_ENTRIES.items():
        yield CORNERS.target(what, edited(put(name, change)), None, name, file)
    hostile = {"an object": lambda file: file.write_bytes(Bomb.npz("features"))}
    yield CORNERS.target("entries that are", hostile, None, (file, "features"), file)


# ------------------------------------------------------------------------------------------------------------ caches

#: What is kept, and how it is read with a cache.
CACHED: dict[str, tuple[Callable[[], Path], Callable[[Path, Any], TensorDict]]] = {
    "kitti": (drives, lambda root, cache: read_drive(root, cache=cache)),
    "lerobot": (V2.sound, lambda root, cache: read_episodes(root, cache=cache)),
    "ur5": (demos, lambda root, cache: read_demos(root, cache=cache)),
    "recordings": (own, lambda root, cache: read_own(root, camera="images", replay={"cache": cache})),
}


def _again(name: str, change: d.Change, folder: Path) -> tuple[TensorDict, TensorDict, list[str]]:
    """Returns what is read the first time, and again with a changed entry; and what is left half written."""
    sound, read = CACHED[name]
    root, cache = d.copied(sound(), folder), folder / "cache"
    first = read(root, cache).clone()
    (entry,) = [path for path in cache.iterdir() if path.is_dir() and not path.name.startswith(".")]
    change(entry)
    return first, read(root, cache).clone(), [path.name for path in cache.glob(".writing*")]


def _as_before(result: tuple[TensorDict, TensorDict, list[str]]) -> bool:
    first, second, left = result
    return not left and same(second, first)


def _of_part(part: str, change: d.Change) -> d.Change:
    """Changes a file of an entry."""

    def act(entry: Path) -> None:
        files = sorted(filter(Path.is_file, entry.rglob("*")), key=lambda path: (path.stat().st_size, path.name))
        described = [path for path in files if path.suffix == ".json"]
        tensors = [path for path in files if path.suffix != ".json"]
        change({"largest": files[-1], "smallest": tensors[0], "description": described[0]}[part])

    return act


def _planted_entry(entry: Path) -> None:
    """An entry of tensordict's own format, with a pickle that runs code."""
    gone(entry)
    TensorDict({"image": torch.zeros(3), "evil": NonTensorData(Bomb())}, []).memmap(entry)
    shutil.rmtree(Path.cwd() / MARK, ignore_errors=True)


def _half_written(entry: Path) -> None:
    """Leaves what a process that was killed leaves, with the lock of none."""
    left = entry.parent / ".writing-killed"
    left.mkdir()
    entry.rename(left / "entry")
    (left / "lock").touch()


ENTRIES = {
    "planted": _planted_entry,
    "a pickle beside": lambda entry: [
        (entry / name).write_bytes(Bomb.pickled()) for name in ("other.pickle", "_metadata.pkl", "entry.pkl")
    ],
    "pickles as tensors": lambda entry: [
        file.write_bytes(Bomb.pickled()) for file in entry.rglob("*") if file.is_file() and file.suffix != ".json"
    ],
    "emptied": lambda entry: [gone(path) for path in entry.iterdir()],
    "a file in its place": instead(Path.touch),
    "a link to nowhere in its place": instead(lambda entry: entry.symlink_to("nowhere")),
    "left half written by a killed process": _half_written,
    "a file more": lambda entry: (entry / "more").write_text("x"),
}


def _nowhere(name: str, cache: Any, folder: Path) -> TensorDict:
    (folder / "file").touch()
    sound, read = CACHED[name]
    return read(d.copied(sound(), folder), cache if isinstance(cache, int) else folder / cache)


def _of_caches() -> Iterator[Target]:
    for name, (sound, _) in CACHED.items():
        target = partial(Target, "caches", words=("cache",), needs=sound)
        for part in ("largest", "smallest", "description"):
            wrong = (d.SEALED | d.PLACES).each(partial(_of_part, part))
            yield target(f"{name}, {part} file", act=partial(_again, name), wrong=wrong, right=_as_before)
        yield target(f"{name}, entry", act=partial(_again, name), wrong=d.Wrong(ENTRIES), right=_as_before)
        nowhere = d.of("file/below", "/dev/null/below", 3)
        yield target(f"{name}, cache", act=partial(_nowhere, name), wrong=nowhere)


def targets() -> Iterator[Target]:
    """Yields all files, and what is kept of them."""
    for kind in (_of_kitti, _of_lerobot, _of_ur5, _of_own, _of_corners, _of_caches):
        yield from kind()
