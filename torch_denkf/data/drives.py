"""Rendered drives in KITTI's layout: data that comes with the library, for tests, examples and first experiments.

A car drives along a random road between houses, trees and parked cars. Speeds, accelerations and turn rates are those
of KITTI's city drives, and what moves in the images moves as the recorded motion says. See
:mod:`torch_denkf.data._scene` for the drawing; any other path can be drawn with the same parts.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import zlib
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from torch_denkf.data import _textures as textures
from torch_denkf.data._camera import Camera
from torch_denkf.data._kitti_files import DEFAULT_DT, state_to_poses, write_poses
from torch_denkf.data._scene import Box, Card, Renderer, Scene

__all__ = ["random_drive", "roadside_scene", "write_drives"]

_FORMAT = 1  # raise it when drives of the same options come out differently
_MARKER = "drive.json"


def write_drives(
    root: str | Path,
    names: str | Iterable[str],
    *,
    frames: int = 300,
    size: tuple[int, int] = (50, 150),
    seed: int = 0,
    overwrite: bool = False,
) -> list[str]:
    """Render drives and write them in the layout that :func:`torch_denkf.data.read_kitti_drive` reads.

    A drive follows from its name, the seed and the options alone, so one that is already there with the same options
    is kept. Writing 300 frames of 50 x 150 takes about a second. Images are noisy by about 1.5 grey values.

    Args:
        root: folder to write ``sequences/NAME/image_2``, ``calib.txt``, ``times.txt`` and ``poses/NAME.txt`` to.
        names: names of the drives, or one name; each is another road.
        frames: images of a drive, at 0.103 s.
        size: (H, W) of the images; the field of view is KITTI's.
        seed: another seed gives other drives of the same names.
        overwrite: replace drives of other options. Only drives that this function wrote are ever replaced.

    Returns:
        The names.

    Raises:
        ValueError: for fewer than two frames, or a name that is not a plain folder name.
        FileExistsError: if there is another drive of that name.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> write_drives(folder, ["town"], frames=5)
        ['town']
        >>> from torch_denkf.data import read_kitti_drive
        >>> read_kitti_drive(folder, "town", cache=None)["image"].shape
        torch.Size([5, 3, 50, 150])
    """
    root, names = Path(root).expanduser(), [names] if isinstance(names, str) else list(names)
    if frames < 2:
        raise ValueError(f"a drive needs at least 2 frames, got {frames}")
    for name in names:
        if not name or Path(name).name != name:
            raise ValueError(f"a drive's name becomes a folder's, such as 'town'; got {name!r}")
    for name in names:
        options = {"format": _FORMAT, "frames": frames, "size": list(size), "seed": seed}
        target = root / "sequences" / name
        if target.exists():
            marker = target / _MARKER
            ours = json.loads(marker.read_text()) if marker.is_file() else None
            if ours == options:
                continue
            if ours is None or not overwrite:
                hint = "choose another name or folder" if ours is None else "pass overwrite=True or choose another name"
                raise FileExistsError(f"{target} is there and is another drive ({ours or 'not rendered'}); {hint}")
        _write(root, name, options)
    return names


def _write(root: Path, name: str, options: dict) -> None:
    rng = np.random.default_rng([options["seed"], zlib.crc32(name.encode())])
    frames, target = options["frames"], root / "sequences" / name
    state = random_drive(frames, rng)
    poses = state_to_poses(state)
    camera = Camera.kitti(tuple(options["size"]))
    renderer = Renderer(roadside_scene(state, rng), camera)
    (root / "poses").mkdir(parents=True, exist_ok=True)
    target.parent.mkdir(parents=True, exist_ok=True)
    # Written beside and renamed: a drive that is there is complete.
    beside = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=root))
    try:
        (beside / "image_2").mkdir()
        for number, pose in enumerate(poses):
            picture = renderer.render(pose)
            grain = rng.standard_normal(picture.shape, dtype=np.float32) * 1.5
            picture = np.clip(picture + grain + 0.5, 0, 255).astype(np.uint8)
            cv2.imwrite(str(beside / "image_2" / f"{number:06d}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        row = f"{camera.fx:.9e} 0 {camera.cx:.9e} 0 0 {camera.fy:.9e} {camera.cy:.9e} 0 0 0 1 0"
        (beside / "calib.txt").write_text("".join(f"P{k}: {row}\n" for k in range(4)))
        (beside / "times.txt").write_text("".join(f"{DEFAULT_DT * k:.6e}\n" for k in range(frames)))
        (beside / _MARKER).write_text(json.dumps(options))
        write_poses(root / "poses" / f"{name}.txt", poses)
        if target.exists():
            shutil.rmtree(target)
        beside.chmod(0o755)
        beside.rename(target)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def random_drive(frames: int, rng: np.random.Generator, dt: float = DEFAULT_DT) -> np.ndarray:
    """A smooth random drive.

    Speed is 0 to 15 m/s with few stops, accelerates by about 1 m/s² and brakes by at most 2, and is low where the
    road is sharply bent: the turn rate stays below 0.5 rad/s and the acceleration to the side about 2.5 m/s².

    Args:
        frames: rows, N.
        rng: source of randomness.
        dt: time between rows in s.

    Returns:
        The state ``[N, 5]``, as :func:`torch_denkf.data.read_kitti_drive` defines it; it starts at the origin, and
        row t follows from row t-1 by v_t, θ_dot_t and the heading half way.
    """
    time = dt * np.arange(frames)
    bend = 0.004 * np.interp(time, *_knots(rng, time[-1], (3, 6), lambda: rng.standard_normal()))  # 1/m
    start = rng.uniform(2, 8)
    while start < time[-1]:
        width, radius = rng.uniform(3, 6), rng.uniform(9, 40)
        inside = np.abs(time - start) < width / 2
        bump = 0.5 + 0.5 * np.cos(2 * np.pi * (time - start) / width)
        bend = bend + np.where(inside, rng.choice([-1, 1]) * bump / radius, 0)
        start += width + rng.exponential(7)
    limit = np.minimum(0.5 / np.maximum(np.abs(bend), 1e-6), np.sqrt(2.5 / np.maximum(np.abs(bend), 1e-6)))

    def wish() -> float:
        return 0.0 if rng.random() < 0.08 else rng.uniform(3, 15)

    target = np.minimum(np.interp(time, *_knots(rng, time[-1], (3, 8), wish)), limit)
    for t in range(frames - 2, -1, -1):  # brake early enough
        target[t] = min(target[t], target[t + 1] + 2.0 * dt)
    for t in range(1, frames):
        target[t] = min(target[t], target[t - 1] + 1.2 * dt)
    half = round(0.5 / dt)  # smooth over a second
    padded = np.pad(target, half, mode="edge")
    speed = np.convolve(padded, np.hanning(2 * half + 3)[1:-1] / (half + 1), mode="valid")
    turn = np.clip(bend * speed, -0.5, 0.5)
    speed[0], turn[0] = speed[1:2].item(), turn[1:2].item()
    theta = np.concatenate([[0], np.cumsum(turn[1:] * dt)])
    heading = theta[1:] - turn[1:] * dt / 2
    step = np.stack([np.cos(heading), np.sin(heading)], -1) * speed[1:, None] * dt
    return np.column_stack([np.concatenate([np.zeros((1, 2)), step.cumsum(0)]), theta, speed, turn])


def _knots(rng: np.random.Generator, end: float, gap: tuple[float, float], draw) -> tuple[list[float], list[float]]:
    times, values = [0.0], [draw()]
    while times[-1] < end:
        times.append(times[-1] + rng.uniform(*gap))
        values.append(draw())
    return times, values


def roadside_scene(path: np.ndarray, rng: np.random.Generator) -> Scene:
    """Put a road under a path, and houses, trees, poles and parked cars beside it.

    Args:
        path: x and y in m, θ in rad, in its first three columns, ``[N, 3]``; the road goes on straight at its end.
        rng: source of randomness.

    Returns:
        The scene; the car drives in the right lane of two.
    """
    line, heading = _every_metre(path)
    left = np.stack([-np.cos(heading), -np.sin(heading)], -1)  # of (x right, z ahead)
    ahead = np.stack([-np.sin(heading), np.cos(heading)], -1)
    road = line + 1.75 * left
    dashes = [(road[k], road[min(k + 3, len(road) - 1)]) for k in range(0, len(road) - 1, 8)]
    for side in (-3.3, 3.3):
        edge = road + side * left
        dashes += list(pairwise(edge))
    where = rng.integers(len(road), size=len(road) // 2)
    place = road[where] + rng.uniform(-5, 5, (len(where), 1)) * left[where]
    axes, angle = rng.uniform(0.3, 1.6, (len(where), 2)), rng.uniform(0, 180, (len(where), 1))
    haze = np.clip(np.array([215, 205, 200]) * rng.uniform(0.75, 1.05), 0, 255)
    return Scene(
        road=road,
        dashes=np.array(dashes),
        blots=np.column_stack([place, axes, angle]),
        objects=_roadside(line, left, ahead, rng),
        ground=textures.ground(rng),
        panorama=textures.panorama(rng, haze),
        haze=haze,
        light=rng.uniform(0.8, 1.15) * (1 + 0.08 * np.array([-1, 0, 1]) * rng.standard_normal()),
    )


def _every_metre(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The path in (x right, z ahead), a point a metre, from 20 m before its start to 110 m after its end; headings."""
    points = np.column_stack([-path[:, 1], path[:, 0]])
    theta = path[:, 2]
    out = np.array([-np.sin(theta), np.cos(theta)]).T
    before, after = (
        points[0] - out[0] * np.arange(20, 0, -1)[:, None],
        points[-1] + out[-1] * np.arange(1, 111)[:, None],
    )
    points = np.concatenate([before, points, after])
    theta = np.concatenate([np.full(20, theta[0]), theta, np.full(110, theta[-1])])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    metres = np.arange(0, along[-1])
    columns = [np.interp(metres, along, column) for column in (*points.T, theta)]
    return np.column_stack(columns[:2]), columns[2]


def _roadside(line: np.ndarray, left: np.ndarray, ahead: np.ndarray, rng: np.random.Generator) -> list[Box | Card]:
    walls = [textures.pyramid(textures.facade(rng), 5) for _ in range(8)]
    trees = [textures.pyramid(textures.tree(rng), 6) for _ in range(6)]
    poles = [textures.pyramid(textures.pole(rng), 6) for _ in range(4)]
    cars = [[textures.pyramid(view, 5) for view in textures.car(rng)] for _ in range(6)]
    kinds = rng.dirichlet([4, 4, 2, 3])  # this drive's share of houses, trees, poles and cars
    objects: list[Box | Card] = []
    for side in (1, -1):  # left, right
        edge = 5.25 if side > 0 else 1.75  # of the road, from the path
        at = 0.0
        while at < len(line) - 1:
            kind = rng.choice(4, p=kinds)
            length = (rng.uniform(8, 18), 2.0, 1.0, 4.3)[kind]
            k = int(min(at + length / 2, len(line) - 1))
            aside = edge + (rng.uniform(4, 8) + 4, rng.uniform(2.5, 6), rng.uniform(0.6, 1.2), 1.3)[kind]
            place = line[k] + side * aside * left[k]
            half = np.array([length / 2, (4.0, 0, 0, 0.85)[kind]])
            corners = place + np.array([[-1, 1], [-1, -1], [1, -1], [1, 1]]) * half @ np.stack([ahead[k], left[k]])
            clear = np.linalg.norm(line[:, None] - corners, axis=-1).min()  # of every other stretch of the path, too
            if kind == 0 and clear > 5:
                wall = walls[rng.integers(len(walls))]
                objects.append(Box(corners, rng.uniform(4, 11), [wall] * 4, pixels_per_metre=8.0))
            elif kind == 1 and clear > 3:
                width = rng.uniform(3, 6)
                objects.append(Card(place, width, width * rng.uniform(1.1, 1.6), trees[rng.integers(len(trees))]))
            elif kind == 2 and clear > 2:
                height = rng.uniform(2.5, 6)
                objects.append(Card(place, height / 4, height, poles[rng.integers(len(poles))]))
            elif kind == 3 and clear > 2:
                flank, rear = cars[rng.integers(len(cars))]
                objects.append(Box(corners, 1.45, [rear, flank, rear, flank]))
            at += length + (rng.uniform(1, 8), rng.uniform(2, 9), rng.uniform(6, 15), rng.uniform(0.8, 12))[kind]
    return objects
