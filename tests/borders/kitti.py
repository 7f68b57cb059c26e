"""Drives in KITTI's layout, and what reads them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import gone, instead, kept, put, renamed, same, written
from benchmarks.reliability.documents import edited
from benchmarks.reliability.target import Source, Subject, Target, targets_of
from tests.borders.folders import SIZES, bomb, made, one_row, picture
from torch_denkf.applications.car import KITTIOdometryExperienceReplay, read_kitti_drive, with_motion, write_drives
from torch_denkf.applications.car.kitti.drive import list_kitti_drives

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


def _frame_masked(row: int, result: TensorDict) -> bool:
    """Tells whether one frame counts as missing, and all else is as without damage."""
    expected = KITTI.reference().clone()
    expected["image"][row], expected["frame_valid"][row] = 0, False
    return same(result, expected, rtol=1e-5, atol=1e-5)


def _times_as_told(result: TensorDict) -> bool:
    """Without stamps, frames come ten times a second, and all that needs no time is as it was."""
    expected = KITTI.reference()
    return same(result["state"][:, :3], expected["state"][:, :3]) and same(result["image"], expected["image"])


NAMES = ("0004.png", "-00004.png", "000004.PNG", "000999.png", "9" * 30 + ".png")
PICTURES = d.SEALED | d.PLACES | d.of(*NAMES).each(renamed) | {"a JPEG": picture(SIZE, ".jpg"), "a bomb": written(bomb)}
NO_PICTURES = {
    "another size": picture((10, 10), ".png"),
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
#: Times of a single frame: far on, far back, none, two, repeated, back, hardly on.
STAMPS = {
    4: d.of(["1e300"], ["-1e300"], [], ["0.1", "0.2"], ["1e9"], ["0.309"], ["0.2"], ["0.3091"]),
    0: d.of(["5.0"]),
    FRAMES - 1: d.of(["0.0"]),
}
#: Clocks that are wrong throughout.
CLOCKS = {
    "stands": [0.5] * FRAMES,
    "goes back": [-0.1 * row for row in range(FRAMES)],
    "begins again": [0.1 * (row % 5) for row in range(FRAMES)],
    "in units of 1e300 s": [1e-300 * row for row in range(FRAMES)],
    "in nanoseconds": [1e8 * row for row in range(FRAMES)],
}


def _files() -> Iterator[Target]:
    picture, names = f"{IMAGES}/000004.png", ("000004.png", "4.png", *NAMES)
    without_times = dict.fromkeys(d.NOTHING.named, _times_as_told)
    yield KITTI.target("poses", d.FILE, _equal_so_far, file=POSE_FILE)
    yield KITTI.target("times.txt", d.FILE, _equal_so_far, file=TIME_FILE, rights=without_times)
    yield KITTI.target("calib.txt", d.FILE, KITTI.like(), file=CALIBRATION_FILE)  # another row of it may be damaged
    yield from KITTI.document(POSE_FILE, skip=one_row)
    yield from KITTI.document(TIME_FILE, skip=one_row)
    yield from KITTI.document(CALIBRATION_FILE, KITTI.like(), skip=one_row, loose=lambda place: place[0] != 2)
    pose = d.Wrong(POSES).each(lambda change: edited(put(4, change)))
    yield KITTI.target("pose 4", pose, None, f"{DRIVE}.txt:5", POSE_FILE)
    for row, values in STAMPS.items():
        stamps = values.each(lambda line, row=row: edited(put(row, line)))
        yield KITTI.target(f"time {row}", stamps, partial(_frame_masked, row), f"times.txt:{row + 1}", TIME_FILE)
    clocks = d.Wrong(CLOCKS).each(lambda times: edited(lambda rows: [[repr(time)] for time in times]))
    yield KITTI.target("clock", clocks, file=TIME_FILE)
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


# -------------------------------------------------------------------------------------------------------- arguments


def drive() -> TensorDict:
    """Returns the rows of the drive."""
    return KITTI.reference().clone()


def _replayed(**given: Any) -> Any:
    data = KITTIOdometryExperienceReplay(drives(), **{"size": SIZE, "cache": None, **given})
    return data.sample() if {"batch_size", "num_slices", "slice_len"} & set(given) else data[:]


def _arguments() -> Iterator[Subject]:
    outside = ("../../../etc", "/etc")
    one = {
        "size": SIZES | d.of(10),
        "camera": d.of("image_9", 2, *outside),
        "drive": d.of("nope", -1, 0.5, "", *outside),
        "colour": d.of("yes", 3),
    }
    share = d.SHARE.but("inf")
    many = {
        "drives": d.of([], [DRIVE, DRIVE], ["nope"], ["../../etc"]),
        "test_share": share,
        "validation_share": share.but("beyond one") | {"one": 1.0},
        "split": d.CHOICE.but("empty"),
        **dict.fromkeys(("batch_size", "num_slices"), d.COUNT),
        "slice_len": d.COUNT.without("fraction") | {"beyond the drive": 1000},
        "cameras": d.of("third", ["image_7"], [], "image_2", ["image_2", "image_2"]),
        "flow": d.Wrong({"text": "yes", "no flow": lambda drive: drive}),
        "slice_length": d.of(4),
    }
    also = {
        "drive": ("sequence", "sequences", "poses", "/etc"),
        "camera": ("image_9",),
        "cameras": ("camera", "image_7"),
        "drives": ("sequences",),
        "slice_len": ("slices",),
    }
    moved = lambda **given: with_motion(drive(), cache=None, **given)  # noqa: E731
    yield KITTI.arguments("read_kitti_drive", wrong=one, also=also)
    yield Subject(_replayed, wrong=many, also=also, name="KITTIOdometryExperienceReplay")
    yield Subject(moved, wrong={"height": d.POSITIVE.but("inf")}, name="with_motion")
    yield Subject(list_kitti_drives, wrong={"root": d.of(".")}, also={"root": ("sequences",)})


def targets() -> Iterator[Target]:
    """Yields all files and arguments."""
    yield from _files()
    yield from targets_of("kitti", *_arguments())
