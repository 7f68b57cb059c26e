"""Drives of stereo corners, and the motion found in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import INF, NAN, put, spoiled
from benchmarks.reliability.documents import edited
from benchmarks.reliability.hostile import Bomb
from benchmarks.reliability.target import Source, Subject, Target, targets_of
from tests.borders.folders import made
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.drive import corner_replay, read_corner_drive
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motion


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


def _files() -> Iterator[Target]:
    file = "drive.npz"
    whole = d.SEALED.without("cut by a byte", "a byte flipped at 0.0")
    yield CORNERS.target(file, whole, CORNERS.like(), file=file)
    yield CORNERS.target(f"{file} in its place", d.PLACES, file=file, within=4)
    yield from CORNERS.document(file)
    for what, (name, change) in BAD_ENTRIES.items():
        yield CORNERS.target(what, edited(put(name, change)), None, name, file)
    hostile = {"an object": lambda file: file.write_bytes(Bomb.npz("features"))}
    yield CORNERS.target("entries that are", hostile, None, (file, "features"), file)


# -------------------------------------------------------------------------------------------------------- arguments


def _arguments() -> Iterator[Subject]:
    corners = torch.rand(6, 3) + torch.tensor([600.0, 180.0, 20.0])
    sound = {"before": corners, "after": corners, "seen": torch.ones(6, dtype=torch.bool)}
    camera = {"focal": 700.0, "center": (600.0, 180.0), "baseline": 0.54}
    shapes = d.of(torch.ones(3), torch.ones(7, 3), torch.ones(6, 4))
    motion = {
        **dict.fromkeys(("before", "after"), shapes),
        "seen": d.of(torch.ones(6), torch.ones(3, dtype=torch.bool)),
        "start": d.of(torch.ones(2, 7), torch.eye(4)),
        "stereo_var": d.of(torch.tensor(1.0)),
        "steps": d.COUNT.but("zero"),
    }
    cameras = {
        **dict.fromkeys(("focal", "baseline"), d.POSITIVE),
        "center": d.vector(2).but("nan", "inf", "a matrix") | d.of((NAN, 1.0), (1.0, INF)),
        "radial": d.of((0.0, 0.0), (0.0, NAN, 0.0), "abc"),
        "disparity_offset": d.of((), (0.0,) * 8, (NAN,), "abc"),
    }
    noise = dict.fromkeys(CornerNoise.__dataclass_fields__, d.NOT_NEGATIVE)
    noise |= dict.fromkeys(("pixel", "disparity", "freedom"), d.POSITIVE)
    rows = {"rows": d.COUNT | {"more than there are": 99, "one": 1}}
    yield CORNERS.arguments("read_corner_drive", wrong=rows)
    yield Subject(lambda **given: StereoCamera(**{**camera, **given}), wrong=cameras, name="StereoCamera")
    yield Subject(lambda **given: CornerNoise(**given), wrong=noise, name="CornerNoise")
    moved = lambda **given: corner_motion(**{**sound, "camera": StereoCamera(**camera), **given})  # noqa: E731
    yield Subject(moved, wrong=motion, name="corner_motion")


def targets() -> Iterator[Target]:
    """Yields all files and arguments."""
    yield from _files()
    yield from targets_of("corners", *_arguments())
