"""Creates a random scene along a path: the road's surface, and objects next to it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from torch_denkf.applications.car.street import textures
from torch_denkf.applications.car.street.camera import HEIGHT
from torch_denkf.applications.car.street.path import Path
from torch_denkf.applications.car.street.scene import Box, Card, Scene, lane_marks
from torch_denkf.applications.car.street.terrain import Terrain
from torch_denkf.applications.car.street.traffic import FAST, traffic

__all__ = ["roadside_scene"]

CELLS = 16e6  # largest size of the occupancy map
APART = 30  # m along the path: nearby points that are farther apart along the path belong to another visit
HOUSE, TREE, POLE, CAR, HEDGE = range(5)


def roadside_scene(
    path: np.ndarray, rng: np.random.Generator, *, ground: np.ndarray | None = None, traffic_on: bool = False
) -> Scene:
    """Puts a road under a path, and houses, hedges, trees, poles and parked cars next to it.

    No object is on the road, also if the path crosses or repeats itself: one scene serves all visits.

    Args:
        path: x and y in m, θ in rad, in its first three columns, ``[N, 3]``; the road continues straight at its end.
        rng: source of randomness.
        ground: height of the ground under the car in each row, KITTI's y (down) in m, ``[N]``; by default level,
            1.65 m under a camera at 0.
        traffic_on: whether there are moving cars.

    Returns:
        The scene; the car drives in the right lane of two.

    Examples:
        >>> import numpy as np
        >>> straight = np.column_stack([np.arange(100.0), np.zeros(100), np.zeros(100)])
        >>> scene = roadside_scene(straight, np.random.default_rng(0))
        >>> scene.road[0].tolist(), scene.road[-1].tolist()  # (x to the right, z ahead), in m
        ([-1.75, -20.0], [-1.75, 239.0])
        >>> bool((abs(scene.places[:, 0] + 1.75) > scene.road_width / 2).all())
        True
    """
    way = Path.of(path, np.full(len(path), HEIGHT) if ground is None else ground)
    fast = len(path) > 1 and float(np.median(np.diff(way.along))) > FAST * 0.1
    left, road = way.left, way.line + 1.75 * way.left
    width, verge = (rng.uniform(9, 12), 1.0) if fast else (rng.uniform(6.6, 8.5), rng.uniform(0.3, 3.0))
    edges = ((), (width / 2 - 0.3, 0.3 - width / 2))[int(fast or rng.random() < 0.5)]
    marked = _first_visit(way.line) if fast or rng.random() < 0.8 else np.zeros(len(road), bool)
    where = rng.integers(len(road), size=len(road) // 2)
    place = road[where] + rng.uniform(-width / 2, width / 2, (len(where), 1)) * left[where]
    axes, angle = rng.uniform(0.3, 1.6, (len(where), 2)), rng.uniform(0, 180, (len(where), 1))
    haze = np.clip(np.array([215, 205, 200]) * rng.uniform(0.75, 1.05), 0, 255)
    views = [[textures.pyramid(view, 5) for view in textures.car(rng)] for _ in range(8)]
    cars = [[front, side, rear, side] for side, rear, front in views]
    bearing, sunny = rng.uniform(0, 2 * np.pi), rng.random() < 0.65
    sun = rng.uniform(0.5, 1.8) * np.array([np.sin(bearing), np.cos(bearing)]) if sunny else np.zeros(2)
    return Scene(
        road=road,
        dashes=lane_marks(road, left, marked, edges),
        blots=np.column_stack([place, axes, angle]),
        objects=_Roadside(way, road, width, verge, rng).fill(cars, fast),
        ground=textures.ground(rng),
        panorama=textures.panorama(rng, haze),
        haze=haze,
        light=rng.uniform(0.85, 1.3) * (1 + 0.08 * np.array([-1, 0, 1]) * rng.standard_normal()),
        terrain=Terrain(way.line, way.heights),
        metres=np.round(way.along).astype(int),
        road_width=width,
        verge=verge,
        traffic=traffic(way, cars, rng) if traffic_on else [],
        sun=sun,
        shade=rng.uniform(0.5, 0.8) if sunny else 1.0,
        gamma=rng.uniform(0.85, 1.5),
        exposure=_exposure(len(path), rng) if traffic_on else None,
    )


def _exposure(frames: int, rng: np.random.Generator) -> np.ndarray:
    """Returns a gain that varies by about 8 % within seconds."""
    knots = np.arange(0, frames + 40, 40)
    return np.interp(np.arange(frames), knots, np.exp(0.08 * rng.standard_normal(len(knots))))


def _first_visit(line: np.ndarray) -> np.ndarray:
    """Masks the points of a line that are not within 6 m of an earlier visit."""
    # Points are painted backwards on a map of 1 m pixels, so that each pixel has the number of the first visit.
    low = line.min(0) - 8
    shape = np.ceil(line.max(0) - low + 8).astype(int) + 1
    step = max(1.0, np.sqrt(shape[0] * shape[1] / CELLS))
    cells = np.floor((line - low) / step).astype(np.int32)
    first = np.full(np.ceil(shape / step).astype(int)[::-1] + 1, len(line), np.int32)
    for k in range(len(line) - 1, -1, -1):
        cv2.circle(first, cells[k].tolist(), max(1, round(6 / step)), k, -1)
    return np.arange(len(line)) - first[cells[:, 1], cells[:, 0]] < APART


class _Roadside:
    """Places objects one by one in free space."""

    def __init__(self, way: Path, road: np.ndarray, width: float, verge: float, rng: np.random.Generator):
        self.way, self.width, self.verge, self.rng = way, width, verge, rng
        self.low = road.min(0) - 40
        span = road.max(0) - self.low + 40
        self.cell = max(0.5, float(np.sqrt(span[0] * span[1] / CELLS)))
        free = np.full(np.ceil(span / self.cell).astype(int)[::-1] + 1, 255, np.uint8)
        cv2.polylines(free, [self._pixels(road)], False, 0, max(1, round(width / self.cell)), cv2.LINE_8, 4)
        self.clear = cv2.distanceTransform(free, cv2.DIST_L2, 3) * self.cell  # m to the nearest road's edge
        self.taken = np.zeros_like(free)

    def _pixels(self, points: np.ndarray) -> np.ndarray:  # in sixteenths
        return np.round((points - self.low) / self.cell * 16).astype(np.int32)

    def _take(self, corners: np.ndarray, distance: float) -> bool:
        """Reserves a footprint if it is clear of all roads and objects; returns True on success."""
        x, z = np.round((corners - self.low) / self.cell).astype(int).T
        if x.min() < 0 or z.min() < 0 or x.max() >= self.taken.shape[1] or z.max() >= self.taken.shape[0]:
            return False
        view = slice(z.min(), z.max() + 1), slice(x.min(), x.max() + 1)
        mask = np.zeros(self.taken[view].shape, np.uint8)
        cv2.fillConvexPoly(mask, np.stack([x - x.min(), z - z.min()], -1).astype(np.int32), 1)
        inside = mask > 0
        if self.taken[view][inside].any() or self.clear[view][inside].min() < distance:
            return False
        self.taken[view][inside] = 1
        return True

    def fill(self, cars: list[list[list[np.ndarray]]], fast: bool) -> list[Box | Card]:
        """Returns all objects next to the road, on both sides."""
        rng, way = self.rng, self.way
        make = self._makers(cars)
        kinds = rng.dirichlet([0.5, 5, 3, 0.1, 3] if fast else [4, 4, 2, 3, 2])  # this drive's share of each kind
        lengths: tuple[Callable[[], float], ...] = (
            lambda: rng.uniform(8, 18), lambda: 2.0, lambda: 1.0, lambda: 4.3, lambda: rng.uniform(5, 16),
        )  # fmt: skip
        dense = rng.uniform(0.25, 1.0)
        gaps = dense * np.array([(1, 8), (1, 8), (5, 15), (1, 12), (0.5, 8)])
        half = self.width / 2
        ahead, sideways = way.ahead, way.left
        objects: list[Box | Card] = []
        for side in (1, -1):  # left, right
            edge = half + 1.75 * side  # distance of the road's edge from the path
            at = 0.0
            while at < len(way.line) - 1:
                kind = int(rng.choice(5, p=kinds))
                length = lengths[kind]()
                k = int(min(at + length / 2, len(way.line) - 1))
                item = make[kind](way.line[k], side * sideways[k], ahead[k], edge, length)
                if item is not None:
                    objects.append(item)
                at += length + rng.uniform(*gaps[kind])
            for k in range(0, len(way.line), 1 + round(12 * dense)):  # objects farther from the road
                kind = TREE if fast or rng.random() < 0.7 else HOUSE
                item = make[kind](way.line[k], side * sideways[k], ahead[k], edge + rng.uniform(6, 26), lengths[kind]())
                if item is not None:
                    objects.append(item)
        return objects

    def _makers(self, cars) -> tuple[Callable, ...]:
        rng, verge = self.rng, self.verge
        walls = [textures.pyramid(textures.facade(rng), 5) for _ in range(8)]
        trees = [textures.pyramid(textures.tree(rng), 6) for _ in range(6)]
        poles = [textures.pyramid(textures.pole(rng), 6) for _ in range(4)]
        hedges = [textures.pyramid(textures.hedge(rng), 5) for _ in range(4)]

        def block(place, ahead, half, distance) -> np.ndarray | None:
            # The corners are ordered from x to z on both sides of the road.
            left = np.array([-ahead[1], ahead[0]])
            corners = place + np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * half @ np.stack([ahead, left])
            return corners if self._take(corners, distance) else None

        def house(place, aside, ahead, edge, length):
            middle = place + (edge + verge + rng.uniform(1, 7) + 4) * aside
            height, wall = rng.uniform(4, 11), walls[rng.integers(len(walls))]
            corners = block(middle, ahead, (length / 2, 4.0), 0.8)
            return None if corners is None else Box(corners, height, [wall] * 4, pixels_per_metre=8.0)

        def tree(place, aside, ahead, edge, length):
            foot = place + (edge + rng.uniform(1.2, 7)) * aside
            width, shape = rng.uniform(3, 6), rng.uniform(1.1, 1.6)
            sprite = trees[rng.integers(len(trees))]
            return Card(foot, width, width * shape, sprite) if self._take(_square(foot, 0.4), 0.8) else None

        def pole(place, aside, ahead, edge, length):
            foot = place + (edge + rng.uniform(0.6, 1.2)) * aside
            height, sprite = rng.uniform(2.5, 6), poles[rng.integers(len(poles))]
            return Card(foot, height / 4, height, sprite) if self._take(_square(foot, 0.2), 0.3) else None

        def parked(place, aside, ahead, edge, length):
            middle = place + (edge + 1.2) * aside
            faces, turned = cars[rng.integers(len(cars))], rng.random() < (0.8 if edge > self.width / 2 else 0.1)
            corners = block(middle, ahead, (length / 2, 0.87), 0.1)
            return None if corners is None else Box(corners, 1.45, faces[2:] + faces[:2] if turned else faces)

        def hedge(place, aside, ahead, edge, length):
            middle = place + (edge + verge + rng.uniform(0.6, 1.6)) * aside
            height, texture = rng.uniform(0.8, 2.2), hedges[rng.integers(len(hedges))]
            corners = block(middle, ahead, (length / 2, 0.4), 0.3)
            return None if corners is None else Box(corners, height, [texture] * 4, pixels_per_metre=8.0)

        return house, tree, pole, parked, hedge


def _square(centre: np.ndarray, half: float) -> np.ndarray:
    return centre + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
