"""Drives in KITTI's layout."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.damage import finite, gone, instead, kept, same, written
from benchmarks.reliability.documents import edited
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from torch_denkf.applications.car import KITTIOdometryExperienceReplay, read_kitti_drive, with_motion, write_drives
from torch_denkf.applications.car.kitti.drive import list_kitti_drives

DRIVE, FRAMES, SIZE = "town", 10, (24, 72)
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


def _equal_so_far(result: TensorDict) -> bool:
    return len(result) > 0 and same(result, DRIVES.reference()[: len(result)])


def _equal_or_missing(result: TensorDict) -> bool:
    return kept(result, DRIVES.reference())


def _that_picture(result: TensorDict) -> bool:
    """A picture is read by what it holds, whatever its name ends in: this one is of one grey."""
    picture = result["image"][4].flatten()
    return bool((picture == picture[0]).all() and result["frame_valid"].all())


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


def _times_as_told(result: TensorDict) -> bool:
    """Without stamps, frames come ten times a second, and all that needs no time is as it was."""
    expected = DRIVES.reference()
    return same(result["state"][:, :3], expected["state"][:, :3]) and same(result["image"], expected["image"])


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


POSES = d.Wrong(
    {
        "a comment": lambda line: ["#", *line],
        "thirteen numbers": lambda line: [*line, "1"],
        "an empty line": lambda line: [],
        "1e200": lambda line: [*line[:11], "1e200"],
        "a jump of 1e9 m": lambda line: [*line[:3], "1e9", *line[4:]],
    }
)
TIMES = d.of(["1e300"], ["-1e300"], [], ["0.1", "0.2"])
CALIBRATION = {
    f"{value} in place {place}": d.put((2, place), value)
    for place, value in ((1, "0"), (1, "-700"), (6, "0"), (1, "1e300"), (0, "Q2:"))
}


def _files() -> Iterator[Target]:
    yield DRIVES.target("poses", d.FILE, _equal_so_far, file=POSE_FILE)
    optional = dict.fromkeys(("taken away", "a link to nowhere", "a link to itself"), _times_as_told)
    yield DRIVES.target("times.txt", d.FILE, _equal_so_far, file=TIME_FILE, rights=optional)
    yield DRIVES.target("calib.txt", d.FILE, DRIVES.equal, file=CALIBRATION_FILE)  # another row of it may be damaged
    rows = lambda place: len(place) == 1  # noqa: E731  # without one, the others are sound
    yield from DRIVES.document(POSE_FILE, None, skip=rows)
    yield from DRIVES.document(TIME_FILE, None, skip=rows)
    yield from DRIVES.document(CALIBRATION_FILE, DRIVES.equal, skip=rows, loose=lambda place: place[0] != 2)
    yield DRIVES.target("pose 4", POSES.each(lambda change: edited(d.put((4,), change))), file=POSE_FILE)
    times = TIMES.each(lambda line: edited(d.put((4,), line)))
    yield DRIVES.target("time 4", times, _times_masked, file=TIME_FILE)
    yield DRIVES.target("calibration", d.Wrong(CALIBRATION).each(edited), file=CALIBRATION_FILE)
    names = ("000004.png", "4.png", *RENAMED.values())
    yield DRIVES.target("picture", PICTURES, _equal_or_missing, names, PICTURE, rights={"a JPEG": _that_picture})
    yield DRIVES.target("picture of", NO_PICTURES, None, names, PICTURE)
    emptied = lambda folder: [file.write_bytes(b"") for file in folder.iterdir()]  # noqa: E731
    yield DRIVES.one("all pictures empty", emptied, "image_2", file=IMAGES)
    no_pictures = lambda folder: [gone(file) for file in folder.iterdir()]  # noqa: E731
    yield DRIVES.one("no pictures", no_pictures, ("image_2", DRIVE), file=IMAGES)
    for name, words in (("poses", f"{DRIVE}.txt"), (SEQUENCE, DRIVE), ("sequences", "sequences"), ("", "sequences")):
        yield DRIVES.one(f"no folder {name}", gone, words, file=name)
    yield DRIVES.one("a file as root", instead(Path.touch), "sequences")


COUNTS = d.Wrong({"zero": 0, "negative": -4, "a fraction": 2.5, "text": "many"}, d.COUNT.others)
NO_SHARE = d.SHARE.but("inf")
OUTSIDE = {"outside": "../../../etc", "absolute": "/etc"}
ARGUMENTS = {
    "size": d.SIZE | {"fractions": (1.5, 2.5), "a number": 10},
    "camera": d.Wrong({"unknown": "image_9", "a number": 2, **OUTSIDE}),
    "drive": d.Wrong({"unknown": "nope", "negative": -1, "a fraction": 0.5, "empty": "", **OUTSIDE}),
    "colour": d.of("yes", 3),
}
OPTIONS = {
    "drives": d.of([], [DRIVE, DRIVE], ["nope"], ["../../etc"]),
    "test_share": NO_SHARE,
    "validation_share": NO_SHARE.but("beyond one") | {"one": 1.0},
    "split": d.CHOICE.but("empty"),
    "batch_size": COUNTS,
    "num_slices": COUNTS,
    "slice_len": COUNTS.but("a fraction") | {"beyond the drive": 1000},
    "cameras": d.of("third", ["image_7"], []),
    "flow": d.Wrong({"text": "yes", "no flow": lambda drive: drive}),
    "slice_length": d.of(4),
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
    moved = {"height": d.POSITIVE.but("inf")}
    nothing = {"root": d.of(".")}
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
