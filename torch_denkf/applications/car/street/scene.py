"""Static and moving objects of a rendered drive, and the ground's texture from above.

All objects except the cars of ``Scene.traffic`` are fixed in the world, in KITTI's axes: x right, y down, z forward,
metres. Positions are (x, z): objects stand on the ground, whose height
:mod:`torch_denkf.applications.car.street.terrain` gives.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np

from torch_denkf.applications.car.street import textures
from torch_denkf.applications.car.street.terrain import Terrain

RESOLUTION = 0.1  # m for each pixel of the ground's texture
PATCH = 1536  # pixels: size of the drawn patch of ground, 154 m


@dataclass
class Box:
    """An upright block: house, hedge or parked car. ``corners`` are its (x, z), ``[4, 2]``, in m; x turns to z."""

    corners: np.ndarray
    height: float
    faces: list[list[np.ndarray]]  # a texture pyramid for each of the four sides
    pixels_per_metre: float | None = None  # None stretches the texture over the side


@dataclass
class Card:
    """An upright picture that faces the camera: tree or pole. ``sprite`` is a premultiplied BGRA pyramid."""

    foot: np.ndarray  # (x, z) in m
    width: float
    height: float
    sprite: list[np.ndarray]


@dataclass
class Mover:
    """Moving car: positions and headings over time.

    Attributes:
        first: number of the frame of the first row of ``track``.
        track: x, z and the heading's (x, z) in each frame, ``[T, 4]``.
        length: in m, as width and height.
        faces: texture pyramids of front, left, rear and right.
    """

    first: int
    track: np.ndarray
    length: float
    width: float
    height: float
    faces: list[list[np.ndarray]]

    def at(self, frame: int) -> Box | None:
        """Returns the car in a frame, or None if it does not exist."""
        if not 0 <= frame - self.first < len(self.track):
            return None
        x, z, ahead, up = self.track[frame - self.first]
        along, left = np.array([ahead, up]) * self.length / 2, np.array([-up, ahead]) * self.width / 2
        corners = np.array([x, z]) + np.stack([along - left, along + left, left - along, -along - left])
        return Box(corners, self.height, self.faces)


@dataclass
class Scene:
    """Content of the rendered world.

    Attributes:
        road: the centre line of the road, (x, z) in m, ``[M, 2]``.
        dashes: start and end of lane marks, ``[D, 2, 2]``, in m.
        blots: patches on the road: x, z, half axes in m, angle in degrees, ``[P, 5]``.
        objects: boxes and cards.
        ground: textures of grass, pavement and asphalt, BGR, that repeat.
        panorama: sky and skyline all around, BGR ``[rows, columns]``; the horizon is its last row.
        haze: colour of far things, BGR.
        light: factors of B, G and R.
        terrain: the ground's height.
        metres: index of the terrain's point at the camera's position in each frame, ``[N]``.
        road_width: in m.
        verge: width of the pavement on each side, in m.
        traffic: cars that move.
        sun: (x, z) towards the sun; its norm is the length of shadows per metre of height; zero without shadows.
        shade: brightness in shadows.
        exposure: the camera's gain in each frame, ``[N]``, or None for 1.
        gamma: exponent of the grey values: contrast.
    """

    road: np.ndarray
    dashes: np.ndarray
    blots: np.ndarray
    objects: list[Box | Card]
    ground: tuple[np.ndarray, np.ndarray, np.ndarray]
    panorama: np.ndarray
    haze: np.ndarray
    light: np.ndarray
    terrain: Terrain
    metres: np.ndarray
    road_width: float = 7.0
    verge: float = 1.75
    traffic: list[Mover] = field(default_factory=list)
    sun: np.ndarray = field(default_factory=lambda: np.zeros(2))
    shade: float = 0.6
    exposure: np.ndarray | None = None
    gamma: float = 1.0

    def __post_init__(self):
        self.places = np.array([_centre(item) for item in self.objects]).reshape(-1, 2)
        self.marks = self.dashes.mean(1) if len(self.dashes) else np.zeros((0, 2))

    def draw_ground(self, origin: np.ndarray) -> np.ndarray:
        """Draws the ground from above, ``[PATCH, PATCH, 3]``; pixel (0, 0) is at ``origin`` (x, z) in m."""
        offset = np.round(origin / RESOLUTION).astype(int) % textures.TILE
        rows, columns = slice(offset[1], offset[1] + PATCH), slice(offset[0], offset[0] + PATCH)
        grass, pavement, asphalt = (texture[rows, columns] for texture in self.ground)
        reach = PATCH * RESOLUTION / 2

        def pixels(points: np.ndarray) -> np.ndarray:  # in sixteenths of a pixel
            return np.round((points - origin) * (16 / RESOLUTION)).astype(np.int32)

        def near(points: np.ndarray, margin: float) -> np.ndarray:
            return np.abs(points - origin - reach).max(-1) < reach + margin

        patch = grass.copy()
        inside = np.flatnonzero(near(self.road, 30.0))
        runs = np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1)
        lines = [pixels(self.road[run]) for run in runs if len(run)]
        for texture, width in ((pavement, self.road_width + 2 * self.verge), (asphalt, self.road_width)):
            mask = np.zeros(patch.shape[:2], np.uint8)
            cv2.polylines(mask, lines, False, 255, round(width / RESOLUTION), cv2.LINE_8, 4)
            cv2.copyTo(texture, mask, patch)
        dark = np.zeros(patch.shape[:2], np.uint8)
        for x, z, a, b, angle in self.blots[near(self.blots[:, :2], 0.0)]:
            centre, axes = pixels(np.array([x, z])), (round(a * 16 / RESOLUTION), round(b * 16 / RESOLUTION))
            cv2.ellipse(dark, centre.tolist(), axes, angle, 0, 360, 255, -1, cv2.LINE_8, 4)
        cv2.copyTo(cv2.convertScaleAbs(patch, alpha=0.75), dark, patch)
        cv2.polylines(
            patch, list(pixels(self.dashes[near(self.marks, 5.0)])), False, (215, 215, 215), 2, cv2.LINE_AA, 4
        )
        if self.sun.any():
            dark[:] = 0
            for k in np.flatnonzero(near(self.places, 25.0)):
                self._shadow(dark, self.objects[k], pixels)
            cv2.copyTo(cv2.convertScaleAbs(patch, alpha=self.shade), dark, patch)
        return patch

    def _shadow(self, dark: np.ndarray, item: Box | Card, pixels) -> None:
        away = -self.sun * min(item.height, 9.0)  # shadow of the top
        if isinstance(item, Box):
            hull = cv2.convexHull(pixels(np.concatenate([item.corners, item.corners + away])))
            cv2.fillConvexPoly(dark, hull, 255, cv2.LINE_8, 4)
            return
        thick = max(1, round((0.35 if item.width > 2 else 0.12) / RESOLUTION))
        foot, top = pixels(np.stack([item.foot, item.foot + away])).tolist()
        cv2.line(dark, foot, top, 255, thick, cv2.LINE_8, 4)
        if item.width > 2:  # a tree's crown
            centre, length = item.foot + 0.62 * away, np.linalg.norm(away)
            axes = (round(0.3 * length * 16 / RESOLUTION) + 1, round(0.35 * item.width * 16 / RESOLUTION))
            angle = np.degrees(np.arctan2(away[1], away[0]))
            cv2.ellipse(dark, pixels(centre).tolist(), axes, angle, 0, 360, 255, -1, cv2.LINE_8, 4)


def lane_marks(road: np.ndarray, left: np.ndarray, keep: np.ndarray, edges: tuple[float, ...]) -> np.ndarray:
    """Returns dashes of 3 m every 8 m along the middle of a road, and lines at its edges.

    Args:
        road: centre line, one point per metre, ``[M, 2]``.
        left: unit vectors to its left, ``[M, 2]``.
        keep: mask of points with markings, ``[M]`` bool.
        edges: offsets of solid lines to the left of the middle, in m.

    Returns:
        Start and end of each piece, ``[D, 2, 2]``.
    """
    marks = [(road[k], road[k + 3]) for k in range(0, len(road) - 3, 8) if keep[k : k + 4].all()]
    for side in edges:
        line = road + side * left
        marks += [pair for k, pair in enumerate(pairwise(line)) if keep[k] and keep[k + 1]]
    return np.array(marks).reshape(-1, 2, 2)


def _centre(item: Box | Card) -> np.ndarray:
    return item.corners.mean(0) if isinstance(item, Box) else item.foot
