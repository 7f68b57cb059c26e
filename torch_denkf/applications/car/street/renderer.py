"""Draws a scene from camera poses, with OpenCV and NumPy only.

Image motion is that of a pinhole camera: every pixel of the ground is its ray's intersection with the terrain, walls
are vertical planes warped by their homographies, trees and poles are upright cards, the skyline is infinitely far. The
pose may rotate about all axes. An image depends only on pose and frame number, not on earlier images.
"""

from __future__ import annotations

import cv2
import numpy as np

from torch_denkf.applications.car.street import raster, textures
from torch_denkf.applications.car.street.camera import Camera
from torch_denkf.applications.car.street.scene import PATCH, RESOLUTION, Scene
from torch_denkf.applications.car.street.terrain import Relief
from torch_denkf.applications.car.street.things import FAR, HAZE, Things

GRID = 16  # m: distance after which new ground is drawn
DEPTHS = np.concatenate([np.geomspace(1.2, 200, 48), [400, 1500, 10000]])  # m: depths of look-ups of the ground
STEP = 16  # pixels: distance of the columns with such look-ups
LEVELS = 6  # levels of the ground's pyramid


class Renderer:
    """Draws a scene.

    Args:
        scene: the scene.
        camera: the camera.
        supersample: (down, across), number of drawn pixels that are averaged to one pixel.
    """

    _relief: Relief  # ground around the present position

    def __init__(self, scene: Scene, camera: Camera, supersample: tuple[int, int] = (3, 2)):
        self.scene, self.camera = scene, camera
        self.fine = fine = camera.supersampled(*supersample)
        height, width = fine.size
        self._a = ((np.arange(width) - fine.cx) / fine.fx).astype(np.float32)  # rays of the pixels are (a, b, 1)
        self._b = ((np.arange(height) - fine.cy) / fine.fy).astype(np.float32)
        self._coarse_a = (np.arange(0, width + STEP, STEP) - fine.cx) / fine.fx
        self._coarse_b = (np.arange(0, height + STEP, STEP) - fine.cy) / fine.fy
        self._across, self._down = raster.hats(width, STEP), raster.hats(height, STEP)
        self._things = Things(scene, fine)
        self._stretch: int | None = None
        self._origin: np.ndarray | None = None
        self._pyramid: list[np.ndarray] = []

    def render(self, pose: np.ndarray, frame: int | None = None) -> np.ndarray:
        """Draws one image.

        Args:
            pose: camera-to-world matrix, ``[3, 4]``.
            frame: number of the frame, which determines the traffic and the position on the road; without it there is
                no traffic, and the position is the nearest point.

        Returns:
            BGR, uint8 ``[H, W, 3]``.
        """
        scene = self.scene
        self._travel(pose, frame)
        inverse, top = self._ground_depth(pose)
        picture = np.empty((*self.fine.size, 3), np.uint8)
        self._sky(picture, pose, int(np.ceil(top.max())) + 1)
        self._ground(picture, pose, inverse, top)
        self._inverse, self._top = inverse, top
        cars = [] if frame is None else [box for mover in scene.traffic if (box := mover.at(frame)) is not None]
        self._things.draw(picture, pose, cars, self._shown)
        averaged = cv2.resize(picture, self.camera.size[::-1], interpolation=cv2.INTER_AREA)
        gain = 1.0 if scene.exposure is None or frame is None else scene.exposure[frame]
        grey = 255 * (np.arange(256) / 255) ** scene.gamma * gain
        table = np.clip(grey[:, None] * scene.light, 0, 255).astype(np.uint8)
        return cv2.LUT(averaged, table[None])

    def _travel(self, pose: np.ndarray, frame: int | None) -> None:
        """Updates the heights of the ground, and of objects on it, around the camera."""
        terrain = self.scene.terrain
        if frame is None:
            metre = int(np.linalg.norm(terrain.line - pose[[0, 2], 3], axis=-1).argmin())
        else:
            metre = int(self.scene.metres[frame])
        stretch = min(round(metre / GRID) * GRID, len(terrain.line) - 1)
        if stretch != self._stretch:
            self._stretch, self._relief = stretch, terrain.around(stretch)
            self._things.settle(self._relief, terrain.line[stretch])

    def _ground_depth(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the ground's inverse depth at each pixel, and the row of the horizon in each column.

        In some columns the ground is looked up at all depths and projected; between them the inverse depth is
        interpolated linearly in row and column, which is exact on a plane.
        """
        (right, down, ahead), place = pose[:, :3].T, pose[:, 3]
        depth = DEPTHS[:, None]
        flat = [place[k] + depth * (self._coarse_a * right[k] + ahead[k]) for k in range(3)]
        drop = 0.0
        for _ in range(3):  # the camera's y to the ground; its axis is nearly the world's
            x, z = flat[0] + drop * down[0], flat[2] + drop * down[2]
            drop = (self._relief.at(x, z) - flat[1]) / down[1]
        row = self.fine.cy + self.fine.fy * drop / depth
        crest = np.minimum.accumulate(row, 0)
        self._hides = bool((row > crest + 1)[DEPTHS < FAR].any())
        height = self.fine.size[0]
        rows = np.arange(height)
        inverse = np.empty((height, row.shape[1]), np.float32)
        for k in range(row.shape[1]):
            inverse[:, k] = np.interp(rows, crest[::-1, k], 1 / DEPTHS[::-1])
        return inverse @ self._across, np.clip(crest[-1], 0, height) @ self._across

    def _sky(self, picture: np.ndarray, pose: np.ndarray, bottom: int) -> None:
        bottom = min(bottom, len(picture))
        right, down, ahead = (pose[:, k] for k in range(3))
        ray = [self._coarse_a * right[k] + self._coarse_b[:, None] * down[k] + ahead[k] for k in range(3)]
        yaw = np.arctan2(ahead[0], ahead[2])  # to the right
        sine, cosine = np.sin(yaw), np.cos(yaw)
        aside, onward = ray[0] * cosine - ray[2] * sine, ray[0] * sine + ray[2] * cosine
        rows, columns = self.scene.panorama.shape[:2]
        scale = columns / (2 * np.pi)
        x = (yaw + np.arctan2(aside, onward)) * scale
        y = rows - 1 + ray[1] / np.hypot(aside, onward) * scale
        down = self._down[:, :bottom].T
        x, y = (down @ values.astype(np.float32) @ self._across for values in (x, np.minimum(y, rows - 1.0)))
        x = np.mod(x, columns)
        picture[:bottom] = cv2.remap(self.scene.panorama, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)

    def _ground(self, picture: np.ndarray, pose: np.ndarray, inverse: np.ndarray, top: np.ndarray) -> None:
        ahead = pose[[0, 2], 3] + 0.3 * PATCH * RESOLUTION * pose[[0, 2], 2]
        origin = np.round(ahead / GRID) * GRID - PATCH * RESOLUTION / 2
        if self._origin is None or (origin != self._origin).any():
            self._origin, self._pyramid = origin, textures.pyramid(self.scene.draw_ground(origin), LEVELS)
        start, height = int(np.floor(top.min())), len(picture)
        end = min(int(np.ceil(top.max())) + 1, height)  # rows from start to end have sky as well
        sky = picture[start:end].copy()
        depth = 1 / inverse[start:]
        middle = depth[:, depth.shape[1] // 2].astype(np.float64)
        place, rotation = (pose[[0, 2], 3] - origin) / RESOLUTION, pose[[0, 2], :3] / RESOLUTION
        x, z = (
            (self._a * np.float32(axis[0]) + np.float32(axis[2]) + self._b[start:, None] * np.float32(axis[1])) * depth
            + np.float32(offset)
            for axis, offset in zip(rotation, place, strict=True)
        )
        # A pixel covers dz x dx of ground; the pyramid's level follows their geometric mean.
        covered = np.sqrt(np.abs(np.gradient(middle)) * middle / self.fine.fx) if len(middle) > 1 else np.ones(1)
        levels = np.clip(np.round(np.log2(np.maximum(covered, 1e-6) / RESOLUTION)), 0, LEVELS - 1).astype(int)
        # Some of the ground's colour remains at the far end: a horizon as bright as the haze would look like water.
        clear = (0.3 + 0.7 * np.exp(-middle / HAZE)).astype(np.float32)[:, None, None]
        row = 0
        while row < len(levels):
            stop = row + int(np.argmax(np.append(levels[row:] != levels[row], True)))
            scale = np.float32(0.5 ** levels[row])
            strip = cv2.remap(
                self._pyramid[levels[row]],
                x[row:stop] * scale,
                z[row:stop] * scale,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            mist = np.float32(self.scene.haze) * (1 - clear[row:stop]) + np.float32(0.5)
            picture[start + row : start + stop] = strip * clear[row:stop] + mist
            row = stop
        above = np.arange(start, end)[:, None] < top
        picture[start:end][above] = sky[above]

    def _shown(self, region: tuple[int, int, int, int], depth: float) -> np.ndarray | None:
        """Masks pixels at a depth that no crest of the road occludes, uint8; None if none is occluded."""
        if not self._hides:
            return None
        x0, y0, x1, y1 = region
        nearer = self._inverse[y0:y1, x0:x1] > 1 / depth * 1.1
        ground = np.arange(y0, y1)[:, None] >= self._top[x0:x1]
        return (~(nearer & ground)).astype(np.uint8)
