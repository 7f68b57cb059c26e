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
from tensordict import TensorDict

from benchmarks.reliability.case import Case, apart, workshop
from benchmarks.reliability.damage import BYTES, copied, finite, gone, same, same_but, written
from torch_denkf.data import (
    KITTIOdometryExperienceReplay,
    list_kitti_drives,
    read_kitti_drive,
    with_motion,
    write_drives,
)

DRIVE, FRAMES, SIZE = "town", 10, (24, 72)
ROWS = (0, 4, FRAMES - 1)  # that are damaged
Change = Callable[[Path], Any]


@cache
def sound() -> Path:
    """A rendered drive."""
    root = workshop() / "kitti"
    apart(lambda: write_drives(root, [DRIVE], frames=FRAMES, size=SIZE))
    return root


def read(root: Path, drive: Any = DRIVE, **options: Any) -> TensorDict:
    """The drive, as a user reads it."""
    return read_kitti_drive(root, drive, **{"size": SIZE, "cache": None, **options})


@cache
def reference() -> TensorDict:
    """The drive without damage."""
    return read(sound())


def _act(change: Change, folder: Path, **options: Any) -> TensorDict:
    root = copied(sound(), folder)
    change(root)
    return read(root, **options)


def poses(root: Path) -> Path:
    """The file of poses."""
    return root / "poses" / f"{DRIVE}.txt"


def sequence(root: Path) -> Path:
    """The folder of the drive."""
    return root / "sequences" / DRIVE


def image(root: Path, number: int = 4) -> Path:
    """A frame's file."""
    return sequence(root) / "image_2" / f"{number:06d}.png"


def on_line(file: Callable[[Path], Path], number: int, change: Callable[[str], str]) -> Change:
    """Changes one line of a text file."""

    def act(root: Path) -> None:
        lines = file(root).read_text().splitlines()
        lines[number] = change(lines[number])
        file(root).write_text("\n".join(lines) + "\n")

    return act


# -------------------------------------------------------------------------------------------------------- what is right


def _equal(result: TensorDict) -> bool:
    return same(result, reference())


def _equal_so_far(result: TensorDict) -> bool:
    return len(result) > 0 and same(result, reference()[: len(result)])


def _equal_or_missing(row: int, result: TensorDict) -> bool:
    return _equal(result) or same_but(result, reference(), [row], ["frame_valid"])


def _true_times(row: int, root_times: np.ndarray, result: TensorDict) -> bool:
    """Right where the motion at a gap is that of the true time between frames, or marked as unknown."""
    expected = reference()
    keep = [k for k in range(FRAMES) if k != row and not (row == 0 and k == 1)]
    others = torch.equal(result["state"][keep], expected["state"][keep]) if len(result) == FRAMES else False
    masks = [
        key
        for key in result.keys()  # noqa: SIM118 - a tensordict's values are rows
        if result[key].dtype == torch.bool and key in ("frame_valid", "state_valid", "motion_valid", "observed")
    ]
    marked = any(not bool(result[key][row].all()) for key in masks)
    dt = np.diff(root_times)[max(row - 1, 0)]
    way = (expected["state"][max(row, 1), :2] - expected["state"][max(row, 1) - 1, :2]).norm()
    speed = abs(float(result["state"][row, 3]) - float(way) / dt) < 1e-3 * max(1.0, float(way) / dt)
    return finite(result) and others and (marked or bool(speed))


def _times_masked(result: TensorDict) -> bool:
    """Right where poses and pictures are as without damage, and frames of a wrong time are marked as missing.

    A first time that is too early is a gap, after which no motion is known.
    """
    expected, seen = reference(), result["frame_valid"].squeeze(-1)
    if len(result) != FRAMES or not finite(result):
        return False
    poses_kept = torch.equal(result["state"][:, :3], expected["state"][:, :3])
    pictures_kept = torch.equal(result["image"][seen], expected["image"][seen])
    gap = bool((result["time"].diff(dim=0) > 10).any())
    return poses_kept and pictures_kept and (not bool(seen.all()) or gap)


# ------------------------------------------------------------------------------------------------------------ damage


def _number(place: int, value: str) -> Callable[[str], str]:
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


POSES: dict[str, Callable[[str], str]] = {
    "nan": _number(3, "nan"),
    "inf": _number(11, "inf"),
    "a word": _number(5, "far"),
    "a comma for a point": _number(3, "1,5"),
    "eleven numbers": lambda line: " ".join(line.split()[:11]),
    "thirteen numbers": lambda line: line + " 1",
    "an empty line": lambda line: "",
    "a comment": lambda line: "# " + line,
    "no rotation": _rotation(np.zeros((3, 3))),
    "a reflection": _rotation(np.diag([1.0, 1.0, -1.0])),
    "a scaled rotation": _rotation(2 * np.eye(3)),
    "a shear": _rotation(np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])),
    "1e200": _number(11, "1e200"),
    "1e30": _number(3, "1e30"),
    "a jump of 1e9 m": _number(3, "1e9"),
}
TIMES: dict[str, Callable[[str], str]] = {
    "nan": lambda line: "nan",
    "inf": lambda line: "inf",
    "a word": lambda line: "noon",
    "two numbers": lambda line: line + " 1.0",
    "an empty line": lambda line: "",
    "1e300": lambda line: "1e300",
    "an hour back": lambda line: f"{float(line) - 3600:.6e}",
    "-1e300": lambda line: "-1e300",
}
CALIBRATION: dict[str, Callable[[str], str]] = {
    "fx zero": _number(1, "0"),
    "fx negative": _number(1, "-700"),
    "fy zero": _number(6, "0"),
    "fx nan": _number(1, "nan"),
    "fx 1e300": _number(1, "1e300"),
    "fx a word": _number(1, "wide"),
    "cx inf": _number(3, "inf"),
    "eleven numbers": lambda line: " ".join(line.split()[:12]),
    "no numbers": lambda line: "P2:",
    "another name": lambda line: "Q2:" + line[3:],
}


def _picture(value: np.ndarray, suffix: str = ".png") -> Change:
    def act(root: Path) -> None:
        image(root).write_bytes(cv2.imencode(suffix, value)[1].tobytes())

    return act


def _bomb(root: Path) -> None:
    """A picture that says that it is of 60,000 x 60,000 pixels."""
    data = bytearray(image(root).read_bytes())
    data[16:24] = struct.pack(">II", 60000, 60000)
    image(root).write_bytes(bytes(data))


def _renamed(name: str) -> Change:
    return lambda root: image(root).rename(image(root).with_name(name))


def _replaced_by_folder(root: Path) -> None:
    gone(image(root))
    image(root).mkdir()


def _dangling(root: Path) -> None:
    gone(image(root))
    image(root).symlink_to("nowhere.png")


#: By what is done to the picture of frame 4: the words of an error, and whether a warning and a mask will do.
PICTURES: dict[str, tuple[Change, bool]] = {
    **{what: (lambda root, change=change: written(image(root), change), True) for what, change in BYTES.items()},
    "another size": (_picture(np.full((10, 10, 3), 7, np.uint8)), False),
    "a JPEG": (_picture(np.full((*SIZE, 3), 7, np.uint8), ".jpg"), True),
    "taken away": (lambda root: gone(image(root)), True),
    "a folder": (_replaced_by_folder, True),
    "a link to nowhere": (_dangling, True),
    "a bomb": (_bomb, True),
    "four digits in its name": (_renamed("0004.png"), True),
    "a minus in its name": (_renamed("-00004.png"), True),
    "capitals in its name": (_renamed("000004.PNG"), True),
    "the same number twice": (lambda root: shutil.copy(image(root, 3), image(root).with_name("4.png")), False),
    "a number beyond the poses": (_renamed("000999.png"), True),
    "a number of thirty digits": (_renamed("9" * 30 + ".png"), True),
}


def _files() -> Iterator[Case]:
    files = {
        "poses": poses,
        "times.txt": lambda root: sequence(root) / "times.txt",
        "calib.txt": lambda root: sequence(root) / "calib.txt",
    }
    for name, file in files.items():
        word = f"{DRIVE}.txt" if name == "poses" else name
        for what, change in BYTES.items():
            act = partial(_act, lambda root, file=file, change=change: written(file(root), change))
            right = _equal if name == "calib.txt" else _equal_so_far  # of calib.txt another row may be damaged
            yield Case("kitti", f"{name} {what}", (word,), act, right)
        yield Case(
            "kitti",
            f"{name} is a folder",
            (word,),
            partial(_act, lambda root, file=file: (gone(file(root)), file(root).mkdir())),
        )
    for name in ("poses", "calib.txt"):
        word = f"{DRIVE}.txt" if name == "poses" else name
        yield Case(
            "kitti", f"{name} taken away", (word,), partial(_act, lambda root, file=files[name]: gone(file(root)))
        )
    for what, (change, may_go_on) in PICTURES.items():
        right = partial(_equal_or_missing, 4) if may_go_on else None
        words = ("000004.png", "0004.png", "4.png", "-00004.png", "000004.PNG", "000999.png", "9" * 30 + ".png")
        yield Case("kitti", f"picture {what}", words, partial(_act, change), right)
    everything = lambda root: [file.write_bytes(b"") for file in sequence(root).glob("image_2/*")]  # noqa: E731
    yield Case("kitti", "all pictures empty", ("image_2",), partial(_act, everything))
    for what, change, words in (
        ("no pictures", lambda root: [gone(file) for file in sequence(root).glob("image_2/*")], ("image_2", DRIVE)),
        ("no folder of poses", lambda root: gone(root / "poses"), (f"{DRIVE}.txt",)),
        ("no folder of the drive", lambda root: gone(sequence(root)), (DRIVE,)),
        ("no folder of sequences", lambda root: gone(root / "sequences"), ("sequences",)),
        ("no root", gone, ("sequences",)),
        ("a file as root", lambda root: (gone(root), root.write_text("")), ("sequences",)),
    ):
        yield Case("kitti", what, words, partial(_act, change))


def _numbers() -> Iterator[Case]:
    for row in ROWS:
        for what, change in POSES.items():
            right = (
                (lambda result: _equal(result[: FRAMES - 1]) or same(result, reference()[: FRAMES - 1]))
                if row == FRAMES - 1 and what == "an empty line"
                else None
            )
            yield Case(
                "kitti", f"pose {row}: {what}", (f"{DRIVE}.txt",), partial(_act, on_line(poses, row, change)), right
            )
        for what, change in TIMES.items():
            act = partial(_act, on_line(lambda root: sequence(root) / "times.txt", row, change))
            yield Case("kitti", f"time {row}: {what}", ("times.txt",), act, _times_masked)
    times = np.array((sequence(sound()) / "times.txt").read_text().split(), float)
    for what, row, changed in (
        ("a gap of 100 s", 5, times + 100 * (np.arange(FRAMES) >= 5)),
        ("a repeated stamp", 5, np.where(np.arange(FRAMES) == 5, times[4], times)),
        ("two stamps swapped", 5, times[[0, 1, 2, 3, 5, 4, 6, 7, 8, 9]]),
        ("all stamps equal", 5, np.zeros(FRAMES)),
        ("stamps 1e-300 apart", 5, 1e-300 * np.arange(FRAMES)),
        ("stamps backwards", 5, times[::-1]),
        ("a clock that starts anew", 5, np.where(np.arange(FRAMES) >= 5, times - times[5], times)),
    ):
        text = "\n".join(f"{value:.9e}" for value in changed) + "\n"
        act = partial(_act, lambda root, text=text: (sequence(root) / "times.txt").write_text(text))
        right = partial(_true_times, row, changed) if what in ("a gap of 100 s", "a repeated stamp") else None
        right = _times_masked if what == "two stamps swapped" else right
        yield Case("kitti", what, ("times.txt",), act, right)
    for what, change in CALIBRATION.items():
        act = partial(_act, on_line(lambda root: sequence(root) / "calib.txt", 2, change))
        yield Case("kitti", f"calibration: {what}", ("calib.txt",), act)


ARGUMENTS: dict[str, dict[str, Any]] = {
    "size": {
        "zero": (0, 10),
        "negative": (-5, 10),
        "one number": (10,),
        "text": "ab",
        "fractions": (1.5, 2.5),
        "a number": 10,
    },
    "camera": {"unknown": "image_9", "outside": "../../../etc", "absolute": "/etc", "a number": 2},
    "drive": {
        "unknown": "nope",
        "outside": "../..",
        "absolute": "/etc",
        "negative": -1,
        "a fraction": 0.5,
        "empty": "",
    },
    "colour": {"text": "yes", "a number": 3},
}
OPTIONS: dict[str, dict[str, Any]] = {
    "drives": {"none": [], "twice": [DRIVE, DRIVE], "unknown": ["nope"], "outside": ["../../etc"]},
    "test_share": {"beyond one": 1.5, "negative": -0.1, "nan": float("nan"), "text": "much"},
    "validation_share": {"one": 1.0, "negative": -0.1, "nan": float("nan"), "text": "much"},
    "split": {"unknown": "best", "a number": 3},
    "batch_size": {"zero": 0, "negative": -4, "a fraction": 2.5, "text": "many"},
    "num_slices": {"zero": 0, "negative": -4, "a fraction": 2.5, "text": "many"},
    "slice_len": {"zero": 0, "negative": -4, "beyond the drive": 1000, "text": "long"},
    "cameras": {"unknown": "third", "a folder that is not there": ["image_7"], "none": []},
    "flow": {"text": "yes", "no flow": lambda drive: drive},
    "slice_length": {"no such option": 4},
}


def _arguments() -> Iterator[Case]:
    for name, values in ARGUMENTS.items():
        for what, value in values.items():
            words = {"drive": ("sequence", "sequences", "poses", "drive", "/etc"), "camera": ("camera", "image_9")}.get(
                name, (name,)
            )
            yield Case(
                "kitti", f"read_kitti_drive({name}: {what})", words, partial(_act, lambda root: None, **{name: value})
            )
    for name, values in OPTIONS.items():
        for what, value in values.items():

            def act(folder: Path, name: str = name, value: Any = value) -> Any:
                data = KITTIOdometryExperienceReplay(
                    copied(sound(), folder), **{"size": SIZE, "cache": None, name: value}
                )
                return data.sample() if name in ("batch_size", "num_slices", "slice_len") else data[:]

            also = {"cameras": ("camera", "image_7"), "drives": ("sequences",), "slice_len": ("slices",)}.get(name, ())
            words = (name, *also)
            yield Case("kitti", f"KITTIOdometryExperienceReplay({name}: {what})", words, act)
    yield Case("kitti", "list_kitti_drives of nothing", ("sequences",), lambda folder: list_kitti_drives(folder))
    for key in ("image", "frame_valid", "calibration"):
        act = lambda folder, key=key: with_motion(reference().exclude(key), cache=None)  # noqa: E731
        yield Case("kitti", f"with_motion without {key}", (key,), act)
    for height in (0.0, -1.0, float("nan"), "high"):
        act = lambda folder, height=height: with_motion(reference().clone(), height=height, cache=None)  # noqa: E731
        yield Case("kitti", f"with_motion(height: {height})", ("height",), act)


def cases() -> Iterator[Case]:
    """All damaged drives."""
    sound()  # here, not in each case's process
    yield from _files()
    yield from _numbers()
    yield from _arguments()
