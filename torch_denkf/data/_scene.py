"""A road in the world and a pinhole camera on it, drawn with OpenCV and NumPy alone.

Everything is fixed in the world, in KITTI's axes: x right, y down, z forward, metres, the first camera at the origin
and the ground at y = ``Camera.height``. What moves in the images therefore moves as a pinhole camera's motion predicts:
ground and walls are planes warped by their homographies, trees and poles upright cards, the skyline is infinitely far.
A scene (:class:`Scene`) is drawn from any camera-to-world matrix by :class:`Renderer`; where the camera goes is not its
business.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from torch_denkf.data import _textures as textures
from torch_denkf.data._camera import Camera, ground_homography

RESOLUTION = 0.1  # m for each pixel of the ground's texture
PATCH = 1536  # pixels: the piece of ground that is drawn at a time, 154 m wide
GRID = 16.0  # m: a new piece is drawn when the camera has moved that far
HAZE = 140.0  # m: distance at which haze hides 63 %
NEAR, FAR = 1.0, 90.0  # m


@dataclass
class Box:
    """An upright block: house or parked car. ``corners`` are its (x, z), ``[4, 2]``, in m, so that x turns to z."""

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
class Scene:
    """What stands in the world.

    Attributes:
        road: the centre line of the road, (x, z) in m, ``[M, 2]``.
        dashes: start and end of lane marks, ``[D, 2, 2]``, in m.
        blots: patches and shadows on the road: x, z, half axes in m, angle in degrees, ``[P, 5]``.
        objects: boxes and cards.
        ground: textures of grass, pavement and asphalt, BGR, that repeat.
        panorama: sky and skyline all around, BGR ``[rows, columns]``; the horizon is its last row.
        haze: colour of far things, BGR.
        light: factors of B, G and R.
        road_width: in m.
    """

    road: np.ndarray
    dashes: np.ndarray
    blots: np.ndarray
    objects: list[Box | Card]
    ground: tuple[np.ndarray, np.ndarray, np.ndarray]
    panorama: np.ndarray
    haze: np.ndarray
    light: np.ndarray
    road_width: float = 7.0

    def __post_init__(self):
        self.places = np.array([_centre(item) for item in self.objects]).reshape(-1, 2)

    def draw_ground(self, origin: tuple[float, float]) -> np.ndarray:
        """Picture of the ground from above, ``[PATCH, PATCH, 3]``; pixel (0, 0) is at ``origin`` (x, z) in m."""
        offset = np.round(np.array(origin) / RESOLUTION).astype(int) % textures.TILE
        rows, columns = slice(offset[1], offset[1] + PATCH), slice(offset[0], offset[0] + PATCH)
        grass, pavement, asphalt = (texture[rows, columns] for texture in self.ground)

        def pixels(points: np.ndarray) -> np.ndarray:  # in sixteenths of a pixel
            return np.round((points - origin) * (16 / RESOLUTION)).astype(np.int32)

        patch = grass.copy()
        line = [pixels(self.road)]
        for texture, width in ((pavement, self.road_width + 3.5), (asphalt, self.road_width)):
            mask = np.zeros(patch.shape[:2], np.uint8)
            cv2.polylines(mask, line, False, 255, round(width / RESOLUTION), cv2.LINE_8, 4)
            cv2.copyTo(texture, mask, patch)
        inside = np.abs(self.blots[:, :2] - origin - PATCH * RESOLUTION / 2).max(-1) < PATCH * RESOLUTION / 2
        dark = np.zeros(patch.shape[:2], np.uint8)
        for x, z, a, b, angle in self.blots[inside]:
            centre, axes = pixels(np.array([x, z])), (round(a * 16 / RESOLUTION), round(b * 16 / RESOLUTION))
            cv2.ellipse(dark, centre.tolist(), axes, angle, 0, 360, 255, -1, cv2.LINE_8, 4)
        cv2.copyTo(cv2.convertScaleAbs(patch, alpha=0.6), dark, patch)
        cv2.polylines(patch, list(pixels(self.dashes)), False, (225, 225, 225), 2, cv2.LINE_AA, 4)
        return patch


def _centre(item: Box | Card) -> np.ndarray:
    return item.corners.mean(0) if isinstance(item, Box) else item.foot


class Renderer:
    """Draws a scene from camera poses.

    Args:
        scene: the scene.
        camera: the camera.
        supersample: (down, across), pixels drawn for each pixel of the picture, which averages them.
    """

    def __init__(self, scene: Scene, camera: Camera, supersample: tuple[int, int] = (3, 2)):
        self.scene, self.camera = scene, camera
        self.fine = camera.supersampled(*supersample)
        self._origin, self._pyramid = None, []
        height, width = self.fine.size
        azimuth = np.arctan((np.arange(width) - self.fine.cx) / self.fine.fx)
        rise = (self.fine.cy - np.arange(height))[:, None] / self.fine.fy * np.cos(azimuth)  # tangent of elevation
        rows, columns = scene.panorama.shape[:2]
        self._sky_x = np.broadcast_to(azimuth * columns / (2 * np.pi), rise.shape).astype(np.float32)
        self._sky_y = np.clip(rows - 1 - rise * columns / (2 * np.pi), 0, rows - 1).astype(np.float32)
        depth = self.fine.height * self.fine.fy / np.maximum(np.arange(height) - self.fine.cy, 1e-6)
        self._depth = depth  # of the ground in each row, for a level camera
        # A pixel covers dz x dx of ground; the pyramid's level follows their geometric mean.
        footprint = np.sqrt(depth**2 / (self.fine.height * self.fine.fy) * depth / self.fine.fx)
        self._level = np.clip(np.round(np.log2(footprint / RESOLUTION)), 0, 5).astype(int)
        self._clear = np.exp(-depth / HAZE).astype(np.float32)[:, None, None]
        table = np.clip(np.arange(256)[:, None] * scene.light, 0, 255).astype(np.uint8)
        self._light = table[None]

    def render(self, pose: np.ndarray) -> np.ndarray:
        """Draw one picture.

        Args:
            pose: camera-to-world matrix, ``[3, 4]``, of a level camera (only its heading may turn).

        Returns:
            BGR, uint8 ``[H, W, 3]``.
        """
        picture = self._sky(pose)
        self._ground(picture, pose)
        world_to_camera = pose[:, :3].T
        relative = self.scene.places - pose[[0, 2], 3]
        depth = relative @ world_to_camera[2, [0, 2]]
        aside = relative @ world_to_camera[0, [0, 2]]
        seen = (depth > -10) & (depth < FAR) & (np.abs(aside) < 15 + depth * self.fine.size[1] / (2 * self.fine.fx))
        for k in sorted(np.flatnonzero(seen), key=lambda k: -depth[k]):
            item = self.scene.objects[k]
            if isinstance(item, Card):
                self._card(picture, item, depth[k], aside[k], pose)
            else:
                self._box(picture, item, pose)
        picture = cv2.resize(picture, self.camera.size[::-1], interpolation=cv2.INTER_AREA)
        return cv2.LUT(picture, self._light)

    def _sky(self, pose: np.ndarray) -> np.ndarray:
        columns = self.scene.panorama.shape[1]
        yaw = np.arctan2(pose[0, 2], pose[2, 2])  # to the right
        x = np.mod(self._sky_x + yaw * columns / (2 * np.pi), columns).astype(np.float32)
        return cv2.remap(self.scene.panorama, x, self._sky_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)

    def _ground(self, picture: np.ndarray, pose: np.ndarray) -> None:
        ahead = pose[[0, 2], 3] + 0.3 * PATCH * RESOLUTION * pose[[0, 2], 2]
        origin = tuple(np.round(ahead / GRID) * GRID - PATCH * RESOLUTION / 2)
        if origin != self._origin:
            self._origin, self._pyramid = origin, textures.pyramid(self.scene.draw_ground(origin), 6)
        homography = ground_homography(self.fine, pose, origin, RESOLUTION)
        height, width = self.fine.size
        top = int(np.floor(self.fine.cy)) + 1
        while top < height:
            level = self._level[top]
            bottom = top + int(np.argmax(np.append(self._level[top:] != level, True)))
            shift = np.array([[1, 0, 0], [0, 1, -top], [0, 0, 1.0]])
            strip = cv2.warpPerspective(
                self._pyramid[level],
                shift @ homography @ np.diag([2.0**level, 2.0**level, 1]),
                (width, bottom - top),
                flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            clear = self._clear[top:bottom]
            picture[top:bottom] = strip * clear + self.scene.haze * (1 - clear) + 0.5
            top = bottom

    def _box(self, picture: np.ndarray, box: Box, pose: np.ndarray) -> None:
        camera, rotation = self.fine, pose[:, :3]
        corners = (box.corners - pose[[0, 2], 3]) @ rotation[[0, 2]][:, [0, 2]]  # (right, ahead) of the camera
        sides = []
        for k in range(4):
            a, b = corners[k], corners[(k + 1) % 4]
            if a[0] * b[1] - a[1] * b[0] >= 0 or max(a[1], b[1]) <= NEAR:  # seen from behind, or behind the camera
                continue
            sides.append((k, a, b))
        for k, a, b in sorted(sides, key=lambda side: -(side[1][1] + side[2][1])):
            length = np.linalg.norm(b - a)
            start, end = 0.0, 1.0
            if a[1] < NEAR:
                start = (NEAR - a[1]) / (b[1] - a[1])
            elif b[1] < NEAR:
                end = (NEAR - a[1]) / (b[1] - a[1])
            p, q = a + start * (b - a), a + end * (b - a)
            foot, head = camera.height - pose[1, 3], camera.height - pose[1, 3] - box.height
            quad = np.array([[c[0] / c[1], y / c[1]] for c, y in ((p, head), (q, head), (q, foot), (p, foot))])
            quad = quad * [camera.fx, camera.fy] + [camera.cx, camera.cy]
            face = box.faces[k]
            rows, columns = face[0].shape[:2]
            if box.pixels_per_metre is not None:
                columns = min(columns, length * box.pixels_per_metre)
                rows = min(rows, box.height * box.pixels_per_metre)
            source = np.array(
                [[start * columns, 0], [end * columns, 0], [end * columns, rows], [start * columns, rows]]
            )
            _warp_quad(picture, face, source - 0.5, quad, self.scene.haze, float(np.exp(-min(a[1], b[1]) / HAZE)))

    def _card(self, picture: np.ndarray, card: Card, depth: float, aside: float, pose: np.ndarray) -> None:
        if depth < 2 * NEAR:
            return
        camera = self.fine
        middle = camera.fx * aside / depth + camera.cx
        foot = camera.fy * (camera.height - pose[1, 3]) / depth + camera.cy
        scale = np.array([camera.fx * card.width, camera.fy * card.height]) / depth
        left, top = middle - scale[0] / 2, foot - scale[1]
        region = _region(left, top, left + scale[0], foot, picture.shape)
        if region is None:
            return
        x0, y0, x1, y1 = region
        rows, columns = card.sprite[0].shape[:2]
        sx, sy = scale[0] / columns, scale[1] / rows
        level = _level(1 / np.sqrt(sx * sy), len(card.sprite))
        f = 2.0**level
        matrix = np.array([[sx * f, 0, left - x0], [0, sy * f, top - y0]])
        piece = cv2.warpAffine(card.sprite[level], matrix, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR)
        alpha = piece[..., 3:].astype(np.float32) / 255
        clear = float(np.exp(-depth / HAZE))
        colour = piece[..., :3] * clear + self.scene.haze * ((1 - clear) * alpha)
        view = picture[y0:y1, x0:x1]
        view[:] = view * (1 - alpha) + colour


def _region(left, top, right, bottom, shape) -> tuple[int, int, int, int] | None:
    x0, y0 = max(int(np.floor(left)), 0), max(int(np.floor(top)), 0)
    x1, y1 = min(int(np.ceil(right)) + 1, shape[1]), min(int(np.ceil(bottom)) + 1, shape[0])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def _level(minification: float, levels: int) -> int:
    return int(np.clip(np.round(np.log2(max(minification, 1e-6))), 0, levels - 1))


def _warp_quad(picture, face, source, quad, haze, clear: float) -> None:
    """Lay a texture over a quadrilateral of the picture."""
    region = _region(*quad.min(0), *quad.max(0), picture.shape)
    if region is None:
        return
    x0, y0, x1, y1 = region
    area = max(cv2.contourArea(quad.astype(np.float32)), 1e-3)
    span = source.max(0) - source.min(0)
    level = _level(np.sqrt(span[0] * span[1] / area), len(face))
    shifted = (quad - [x0, y0]).astype(np.float32)
    homography = cv2.getPerspectiveTransform((source / 2.0**level).astype(np.float32), shifted)
    size = (x1 - x0, y1 - y0)
    piece = cv2.warpPerspective(face[level], homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    piece = (piece * clear + haze * (1 - clear)).astype(np.uint8)
    mask = np.zeros(size[::-1], np.uint8)
    corners = np.round(np.clip(shifted, -8000, 8000) * 16).astype(np.int32)
    cv2.fillConvexPoly(mask, corners, 255, cv2.LINE_8, 4)
    cv2.copyTo(piece, mask, picture[y0:y1, x0:x1])
