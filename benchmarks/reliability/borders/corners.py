"""Files of tracked corners, the camera and the noise that they are read with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import workshop
from benchmarks.reliability.documents import edited
from benchmarks.reliability.hostile import Bomb
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.drive import corner_replay, read_corner_drive
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motion

ROWS, CORNERS = 8, 6
NAN, INF = float("nan"), float("inf")


def sound_entries() -> dict[str, np.ndarray]:
    """A drive of eight rows and six corners that all see."""
    random = np.random.default_rng(0)
    left = np.stack([600 + 100 * random.normal(size=(CORNERS, ROWS)), 180 + 20 * random.normal(size=(CORNERS, ROWS))])
    right = left - np.array([20.0, 0.0])[:, None, None]
    return {
        "features": np.concatenate([left, right]),
        "K": np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]]),
        "b": np.array(0.54),
        "cam_T_imu": np.eye(4),
        "rotational_velocity": 0.1 * random.normal(size=(3, ROWS)),
        "time_stamps": np.arange(ROWS)[None] / 10 + 1.3e9,
    }


def _at(place: tuple, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[place] = value
        return array

    return change


#: Entries that are wrong, by what is: their name, and what becomes of them.
BAD_ENTRIES: dict[str, tuple[str, Callable[[np.ndarray], Any]]] = {
    "no corner seen": ("features", lambda array: np.full_like(array, -1)),
    "fewer rows of corners": ("rotational_velocity", lambda array: array[:, :5]),
    "left and right exchanged": ("features", lambda array: array[[2, 3, 0, 1]]),
    "corners below zero": ("features", _at((0, 0, 0), -30.0)),
    "corners of 1e9": ("features", _at((0, 0, 0), 1e9)),
    "a focal length of zero": ("K", _at((0, 0), 0.0)),
    "two focal lengths": ("K", _at((1, 1), 350.0)),
    "a skew": ("K", _at((0, 1), 30.0)),
    "no last row": ("K", _at((2, 2), 0.0)),
    "a baseline of zero": ("b", lambda array: 0.0),
    "a negative baseline": ("b", lambda array: -0.54),
    "a baseline in mm": ("b", lambda array: 540.0),
    "no rotation": ("cam_T_imu", lambda array: 2 * array),
    "a mirror": ("cam_T_imu", _at((0, 0), -1.0)),
    "rates in degrees": ("rotational_velocity", lambda array: 1000 * array),
    "stamps that stand": ("time_stamps", _at((0, 4), 1.3e9 + 0.3)),
    "stamps that go back": ("time_stamps", lambda array: array[:, ::-1]),
}


@cache
def sound() -> Path:
    """A folder with the drive."""
    root = workshop() / "corners"
    root.mkdir()
    np.savez(root / "drive.npz", **sound_entries())
    return root


def read(root: Path, **options: Any) -> Any:
    """All rows, as a user replays them."""
    rows, camera = read_corner_drive(root / "drive.npz", **options)
    replay = corner_replay({"drive": rows.exclude("came_from")}, split="all", cache=None)[:]
    before, after = (camera.corners(rows["corners"][:, :, row]).float() for row in (0, 1))
    start = torch.tensor([1.0, *[0.0] * 6]).expand(len(rows), 7)
    return replay.set("motion", corner_motion(before, after, rows["seen"], camera, start=start, steps=2).motion)


FOLDER = Folder("corners", sound, read)


def _read(**given: Any) -> Any:
    return read(sound(), **given)


def _moved(**given: Any) -> Any:
    """A motion of drawn corners."""
    corners = torch.rand(CORNERS, 3) + torch.tensor([600.0, 180.0, 20.0])
    sound = {"before": corners, "after": corners, "seen": torch.ones(CORNERS, dtype=torch.bool)}
    return corner_motion(**{**sound, "camera": StereoCamera(700.0, (600.0, 180.0), 0.54), **given})


def _camera(**given: Any) -> Any:
    return StereoCamera(**{"focal": 700.0, "center": (600.0, 180.0), "baseline": 0.54, **given})


SHAPES = d.of(torch.ones(3), torch.ones(CORNERS + 1, 3), torch.ones(CORNERS, 4))
MOTION = {
    "before": SHAPES,
    "after": SHAPES,
    "seen": d.of(torch.ones(CORNERS), torch.ones(3, dtype=torch.bool)),
    "start": d.of(torch.ones(2, 7), torch.eye(4)),
    "stereo_var": d.of(torch.tensor(1.0)),
    "steps": d.COUNT.but("zero"),
}
CAMERA = {
    "focal": d.POSITIVE,
    "baseline": d.POSITIVE,
    "center": d.vector(2).but("nan", "inf", "a matrix") | {"nan": (NAN, 1.0), "inf": (1.0, INF)},
    "radial": d.of((0.0, 0.0), (0.0, NAN, 0.0), "abc"),
    "disparity_offset": d.of((), (0.0,) * 8, (NAN,), "abc"),
}
NOISE = {
    name: d.POSITIVE if name in ("pixel", "disparity", "freedom") else d.NOT_NEGATIVE
    for name in CornerNoise.__dataclass_fields__
}


def targets() -> Iterator[Target]:
    """The file, its entries, and the arguments of what is made of them."""
    file = "drive.npz"
    whole = d.SEALED.but("cut by a byte", "a byte flipped at the start").each(d.written)
    yield FOLDER.target(file, whole, FOLDER.equal, file=file)
    yield FOLDER.target(f"{file} in its place", d.PLACES, file=file, within=4)
    yield from FOLDER.document(file, None)
    for what, (name, change) in BAD_ENTRIES.items():
        yield FOLDER.one(what, edited(d.put((name,), change)), (name,), file=file)
    hostile = {"an object": lambda file: file.write_bytes(Bomb.npz("features"))}
    yield FOLDER.target("entries that are", hostile, words=(file, "features"), file=file)
    yield from targets_of(
        "corners",
        Subject(_read, wrong={"rows": d.COUNT | {"more than there are": 99, "one": 1}}, name="read_corner_drive"),
        Subject(_camera, wrong=CAMERA, name="StereoCamera"),
        Subject(lambda **given: CornerNoise(**given), wrong=NOISE, name="CornerNoise"),
        Subject(_moved, wrong=MOTION, name="corner_motion"),
    )
