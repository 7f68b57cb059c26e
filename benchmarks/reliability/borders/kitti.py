"""Drives in KITTI's layout."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from hypothesis import strategies as st
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.damage import finite, gone, in_lines, instead, on_row, same, same_but, written
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from torch_denkf.applications.car import KITTIOdometryExperienceReplay, read_kitti_drive, with_motion, write_drives
from torch_denkf.applications.car.kitti.drive import list_kitti_drives

DRIVE, FRAMES, SIZE = "town", 10, (24, 72)
ROWS = (0, 4, FRAMES - 1)  # that are damaged
POSE_FILE, SEQUENCE = f"poses/{DRIVE}.txt", f"sequences/{DRIVE}"
IMAGES, TIME_FILE, CALIBRATION_FILE = f"{SEQUENCE}/image_2", f"{SEQUENCE}/times.txt", f"{SEQUENCE}/calib.txt"
PICTURE = f"{IMAGES}/000004.png"


@cache
def sound() -> Path:
    """A rendered drive."""
    root = workshop() / "kitti"
    apart(lambda: write_drives(root, [DRIVE], frames=FRAMES, size=SIZE))
    return root


def read(root: Path, drive: Any = DRIVE, **options: Any) -> TensorDict:
    """The drive, as a user reads it."""
    return read_kitti_drive(root, drive, **{"size": SIZE, "cache": None, **options})


DRIVES = Folder("kitti", sound, read)


# -------------------------------------------------------------------------------------------------------- what is right


def _equal_so_far(result: TensorDict) -> bool:
    return len(result) > 0 and same(result, DRIVES.reference()[: len(result)])


def _without_last(result: TensorDict) -> bool:
    return same(result[: FRAMES - 1], DRIVES.reference()[: FRAMES - 1])


def _equal_or_missing(result: TensorDict) -> bool:
    return DRIVES.equal(result) or same_but(result, DRIVES.reference(), [4], ["frame_valid"])


def _that_picture(result: TensorDict) -> bool:
    """A picture is read by what it holds, whatever its name ends in: this one is of one grey."""
    picture = result["image"][4].flatten()
    return bool((picture == picture[0]).all() and result["frame_valid"].all())


def _true_times(change: Callable[[np.ndarray], np.ndarray], result: TensorDict, row: int = 5) -> bool:
    """Right where the motion at a gap is that of the true time between frames, or marked as unknown."""
    expected = DRIVES.reference()
    keep = [k for k in range(FRAMES) if k != row]
    others = len(result) == FRAMES and torch.equal(result["state"][keep], expected["state"][keep])
    masks = {"frame_valid", "state_valid", "motion_valid", "observed"} & set(result.keys())
    marked = any(not bool(result[key][row].all()) for key in masks)
    way = float((expected["state"][row, :2] - expected["state"][row - 1, :2]).norm())
    times = change(np.loadtxt(sound() / TIME_FILE))
    speed = way / np.diff(times)[row - 1]
    right = abs(float(result["state"][row, 3]) - speed) < 1e-3 * max(1.0, speed)
    return finite(result) and others and (marked or bool(right))


def _times_masked(result: TensorDict) -> bool:
    """Right where poses and pictures are as without damage, and frames of a wrong time are marked as missing.

    A first time that is too early is a gap, after which no motion is known.
    """
    expected, seen = DRIVES.reference(), result["frame_valid"].squeeze(-1)
    if len(result) != FRAMES or not finite(result):
        return False
    poses_kept = torch.equal(result["state"][:, :3], expected["state"][:, :3])
    pictures_kept = torch.equal(result["image"][seen], expected["image"][seen])
    gap = bool((result["time"].diff(dim=0) > 10).any())
    return poses_kept and pictures_kept and (not bool(seen.all()) or gap)


# ------------------------------------------------------------------------------------------------------------ damage


def number(place: int, value: str) -> Callable[[str], str]:
    """Another number in a line."""

    def change(line: str) -> str:
        words = line.split()
        words[place] = value
        return " ".join(words)

    return change


def _rotation(matrix: np.ndarray) -> Callable[[str], str]:
    """A pose whose rotation is multiplied from the right."""

    def change(line: str) -> str:
        pose = np.array(line.split(), float).reshape(3, 4)
        pose[:, :3] = pose[:, :3] @ matrix
        return " ".join(f"{value:.9e}" for value in pose.reshape(-1))

    return change


NO_NUMBER = st.sampled_from(["nan", "inf", "-inf", "1e999", "far", "1,5", "0x1f", "1.2.3", "--1"])
POSES = d.Wrong(
    {
        "nan": number(3, "nan"),
        "inf": number(11, "inf"),
        "a word": number(5, "far"),
        "a comma for a point": number(3, "1,5"),
        "eleven numbers": number(11, ""),
        "thirteen numbers": lambda line: line + " 1",
        "an empty line": lambda line: "",
        "a comment": lambda line: "# " + line,
        "no rotation": _rotation(np.zeros((3, 3))),
        "a reflection": _rotation(np.diag([1.0, 1.0, -1.0])),
        "a scaled rotation": _rotation(2 * np.eye(3)),
        "a shear": _rotation(np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])),
        "1e200": number(11, "1e200"),
        "1e30": number(3, "1e30"),
        "a jump of 1e9 m": number(3, "1e9"),
    },
    st.tuples(st.integers(0, 11), NO_NUMBER).map(lambda one: (f"{one[1]} in place {one[0]}", number(*one))),
)
TIMES = d.Wrong(
    {
        "nan": lambda line: "nan",
        "inf": lambda line: "inf",
        "a word": lambda line: "noon",
        "two numbers": lambda line: line + " 1.0",
        "an empty line": lambda line: "",
        "1e300": lambda line: "1e300",
        "an hour back": lambda line: f"{float(line) - 3600:.6e}",
        "-1e300": lambda line: "-1e300",
    },
    NO_NUMBER.map(lambda text: (text, lambda line: text)),
)
CALIBRATION = d.Wrong(
    {
        "fx zero": number(1, "0"),
        "fx negative": number(1, "-700"),
        "fy zero": number(6, "0"),
        "fx nan": number(1, "nan"),
        "fx 1e300": number(1, "1e300"),
        "fx a word": number(1, "wide"),
        "cx inf": number(3, "inf"),
        "eleven numbers": number(12, ""),
        "no numbers": lambda line: "P2:",
        "another name": lambda line: "Q2:" + line[3:],
    },
    st.tuples(st.sampled_from([1, 3, 6, 7]), NO_NUMBER).map(lambda one: (f"{one[1]} in place {one[0]}", number(*one))),
)


def of_lines(wrong: d.Wrong, row: int) -> d.Wrong:
    """Changes of one line of a text file."""
    return wrong.each(lambda change: in_lines(on_row(row, change)))


def _picture(value: np.ndarray, suffix: str = ".png") -> d.Change:
    return lambda file: file.write_bytes(cv2.imencode(suffix, value)[1].tobytes())


def bomb(data: bytes) -> bytes:
    """A picture that says that it is of 60,000 x 60,000 pixels."""
    return data[:16] + struct.pack(">II", 60000, 60000) + data[24:]


RENAMED = {
    "four digits in its name": "0004.png",
    "a minus in its name": "-00004.png",
    "capitals in its name": "000004.PNG",
    "a number beyond the poses": "000999.png",
    "a number of thirty digits": "9" * 30 + ".png",
}
PICTURES = (d.SEALED.each(written) | d.PLACES) | {
    **{what: (lambda file, name=name: file.rename(file.with_name(name))) for what, name in RENAMED.items()},
    "a JPEG": _picture(np.full((*SIZE, 3), 7, np.uint8), ".jpg"),
    "a bomb": written(bomb),
}
NO_PICTURES = {
    "another size": _picture(np.full((10, 10, 3), 7, np.uint8)),
    "the same number twice": lambda file: shutil.copy(file.with_name("000003.png"), file.with_name("4.png")),
}


def _files() -> Iterator[Target]:
    yield DRIVES.target("poses", d.FILE, _equal_so_far, file=POSE_FILE)
    optional = dict.fromkeys(("taken away", "a link to nowhere", "a link to itself"), _times_as_told)
    yield DRIVES.target("times.txt", d.FILE, _equal_so_far, file=TIME_FILE, rights=optional)
    yield DRIVES.target("calib.txt", d.FILE, DRIVES.equal, file=CALIBRATION_FILE)  # another row of it may be damaged
    names = ("000004.png", "4.png", *RENAMED.values())
    yield DRIVES.target("picture", PICTURES, _equal_or_missing, names, PICTURE, rights={"a JPEG": _that_picture})
    yield DRIVES.target("picture of", NO_PICTURES, None, names, PICTURE)
    emptied = lambda folder: [file.write_bytes(b"") for file in folder.iterdir()]  # noqa: E731
    yield DRIVES.one("all pictures empty", emptied, "image_2", file=IMAGES)
    no_pictures = lambda folder: [gone(file) for file in folder.iterdir()]  # noqa: E731
    yield DRIVES.one("no pictures", no_pictures, ("image_2", DRIVE), file=IMAGES)
    yield DRIVES.one("no folder of poses", gone, f"{DRIVE}.txt", file="poses")
    yield DRIVES.one("no folder of the drive", gone, DRIVE, file=SEQUENCE)
    yield DRIVES.one("no folder of sequences", gone, "sequences", file="sequences")
    yield DRIVES.one("no root", gone, "sequences")
    yield DRIVES.one("a file as root", instead(Path.touch), "sequences")


def _times_as_told(result: TensorDict) -> bool:
    """Without stamps, frames come ten times a second, and all that needs no time is as it was."""
    expected = DRIVES.reference()
    return same(result["state"][:, :3], expected["state"][:, :3]) and same(result["image"], expected["image"])


def _restamped(change: Callable[[np.ndarray], np.ndarray]) -> d.Change:
    return in_lines(lambda lines: [f"{value:.9e}" for value in change(np.array(lines, float))])


ROW = np.arange(FRAMES)
STAMPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "a gap of 100 s": lambda times: times + 100 * (ROW >= 5),
    "a repeated stamp": lambda times: np.where(ROW == 5, times[4], times),
    "two stamps swapped": lambda times: times[[0, 1, 2, 3, 5, 4, 6, 7, 8, 9]],
    "all stamps equal": lambda times: 0 * times,
    "stamps 1e-300 apart": lambda times: 1e-300 * ROW,
    "stamps backwards": lambda times: times[::-1],
    "a clock that starts anew": lambda times: np.where(ROW >= 5, times - times[5], times),
}
TOLD = {
    "two stamps swapped": _times_masked,
    "a gap of 100 s": partial(_true_times, STAMPS["a gap of 100 s"]),
    "a repeated stamp": partial(_true_times, STAMPS["a repeated stamp"]),
}


def _numbers() -> Iterator[Target]:
    for row in ROWS:
        last = {"an empty line": _without_last} if row == FRAMES - 1 else {}
        yield DRIVES.target(f"pose {row}", of_lines(POSES, row), file=POSE_FILE, rights=last)
        yield DRIVES.target(f"time {row}", of_lines(TIMES, row), _times_masked, file=TIME_FILE)
    yield DRIVES.target("calibration", of_lines(CALIBRATION, 2), file=CALIBRATION_FILE)
    yield DRIVES.target("stamps", d.Wrong(STAMPS).each(_restamped), file=TIME_FILE, rights=TOLD)


COUNTS = d.Wrong({"zero": 0, "negative": -4, "a fraction": 2.5, "text": "many"}, d.COUNT.others)
NO_SHARE = d.SHARE.but("inf")
OUTSIDE = {"outside": "../../../etc", "absolute": "/etc"}
ARGUMENTS = {
    "size": d.SIZE | {"fractions": (1.5, 2.5), "a number": 10},
    "camera": d.Wrong({"unknown": "image_9", "a number": 2, **OUTSIDE}),
    "drive": d.Wrong({"unknown": "nope", "negative": -1, "a fraction": 0.5, "empty": "", **OUTSIDE}),
    "colour": d.Wrong({"text": "yes", "a number": 3}),
}
OPTIONS = {
    "drives": d.Wrong({"none": [], "twice": [DRIVE, DRIVE], "unknown": ["nope"], "outside": ["../../etc"]}),
    "test_share": NO_SHARE,
    "validation_share": NO_SHARE.but("beyond one") | {"one": 1.0},
    "split": d.CHOICE.but("empty"),
    "batch_size": COUNTS,
    "num_slices": COUNTS,
    "slice_len": COUNTS.but("a fraction") | {"beyond the drive": 1000},
    "cameras": d.Wrong({"unknown": "third", "a folder that is not there": ["image_7"], "none": []}),
    "flow": d.Wrong({"text": "yes", "no flow": lambda drive: drive}),
    "slice_length": d.Wrong({"no such option": 4}),
}
ALSO = {
    "drive": ("sequence", "sequences", "poses", "/etc"),
    "camera": ("image_9",),
    "cameras": ("camera", "image_7"),
    "drives": ("sequences",),
    "slice_len": ("slices",),
}


def _replayed(**given: Any) -> Any:
    data = KITTIOdometryExperienceReplay(sound(), **{"size": SIZE, "cache": None, **given})
    return data.sample() if {"batch_size", "num_slices", "slice_len"} & set(given) else data[:]


def _moved(**given: Any) -> Any:
    return with_motion(DRIVES.reference().clone(), cache=None, **given)


def targets() -> Iterator[Target]:
    """All of a drive, and the arguments of what reads it."""
    yield from _files()
    yield from _numbers()
    moved = {"height": d.POSITIVE.but("inf")}
    nothing = {"root": d.Wrong({"nothing in it": "."})}
    yield from targets_of(
        "kitti",
        DRIVES.arguments("read_kitti_drive", wrong=ARGUMENTS, also=ALSO),
        Subject(_replayed, wrong=OPTIONS, also=ALSO, name="KITTIOdometryExperienceReplay"),
        Subject(_moved, wrong=moved, name="with_motion"),
        Subject(list_kitti_drives, wrong=nothing, also={"root": ("sequences",)}),
    )
    for key in ("image", "frame_valid", "calibration"):
        act = lambda key, folder: with_motion(DRIVES.reference().exclude(key), cache=None)  # noqa: E731
        yield Target("kitti", f"with_motion without {key}", (key,), act, d.Wrong({"taken away": key}))
