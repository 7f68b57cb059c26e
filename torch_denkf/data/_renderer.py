"""Draws a scene from camera poses, with OpenCV and NumPy alone.

What moves in the images moves as a pinhole camera's motion predicts: every pixel of the ground is its ray's point on
the terrain, walls are vertical planes warped by their homographies, trees and poles upright cards, the skyline is
infinitely far. The pose may turn about all axes. A picture follows from pose and frame number alone, not from the
pictures before it.
"""

from __future__ import annotations

import cv2
import numpy as np

from torch_denkf.data import _textures as textures
from torch_denkf.data._camera import Camera
from torch_denkf.data._scene import PATCH, RESOLUTION, Box, Card, Scene

GRID = 16  # m: new ground is drawn when the camera has moved that far
HAZE = 140.0  # m: distance at which haze hides 63 %
NEAR, FAR = 1.0, 90.0  # m
DEPTHS = np.concatenate([np.geomspace(1.2, 200, 48), [400, 1500, 10000]])  # m: where the ground is looked up
STEP = 16  # pixels: columns between those where it is
LEVELS = 6  # of the ground's pyramid


class Renderer:
    """Draws a scene.

    Args:
        scene: the scene.
        camera: the camera.
        supersample: (down, across), pixels drawn for each pixel of the picture, which averages them.
    """

    def __init__(self, scene: Scene, camera: Camera, supersample: tuple[int, int] = (3, 2)):
        self.scene, self.camera = scene, camera
        self.fine = fine = camera.supersampled(*supersample)
        height, width = fine.size
        self._a = ((np.arange(width) - fine.cx) / fine.fx).astype(np.float32)  # of the pixels' rays (a, b, 1)
        self._b = ((np.arange(height) - fine.cy) / fine.fy).astype(np.float32)
        self._coarse_a = (np.arange(0, width + STEP, STEP) - fine.cx) / fine.fx
        self._coarse_b = (np.arange(0, height + STEP, STEP) - fine.cy) / fine.fy
        self._across, self._down = _hats(width), _hats(height)
        self._stretch, self._relief, self._feet = None, None, []
        self._origin, self._pyramid = None, []
        sun = scene.sun / max(np.linalg.norm(scene.sun), 1e-9)
        self._sun = sun * (1 - scene.shade)

    def render(self, pose: np.ndarray, frame: int | None = None) -> np.ndarray:
        """Draw one picture.

        Args:
            pose: camera-to-world matrix, ``[3, 4]``.
            frame: number of the frame, which says where the traffic is and which stretch of the road is travelled;
                without it there is no traffic, and the stretch is the nearest.

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
        boxes = [] if frame is None else [box for mover in scene.traffic if (box := mover.at(frame)) is not None]
        middles = np.array([box.corners.mean(0) for box in boxes]).reshape(-1, 2)
        for box in boxes:
            self._car_shadow(picture, box, pose)
        relative = np.concatenate([scene.places, middles]) - pose[[0, 2], 3]
        depth, aside = relative @ pose[[0, 2], 2], relative @ pose[[0, 2], 0]
        seen = (depth > -10) & (depth < FAR) & (np.abs(aside) < 15 + depth * self.fine.size[1] / (2 * self.fine.fx))
        for k in sorted(np.flatnonzero(seen), key=lambda k: -depth[k]):
            if k >= len(scene.objects):
                box = boxes[k - len(scene.objects)]
                self._box(picture, box, self._relief.at(*box.corners.T), pose)
            elif isinstance(scene.objects[k], Card):
                self._card(picture, scene.objects[k], self._feet[k], depth[k], pose)
            else:
                self._box(picture, scene.objects[k], self._feet[k], pose)
        picture = cv2.resize(picture, self.camera.size[::-1], interpolation=cv2.INTER_AREA)
        gain = 1.0 if scene.exposure is None or frame is None else scene.exposure[frame]
        grey = 255 * (np.arange(256) / 255) ** scene.gamma * gain
        table = np.clip(grey[:, None] * scene.light, 0, 255).astype(np.uint8)
        return cv2.LUT(picture, table[None])

    def _travel(self, pose: np.ndarray, frame: int | None) -> None:
        """Heights of the ground and of what stands on it, for the stretch where the camera is."""
        terrain = self.scene.terrain
        if frame is None:
            metre = int(np.linalg.norm(terrain.line - pose[[0, 2], 3], axis=-1).argmin())
        else:
            metre = int(self.scene.metres[frame])
        stretch = min(round(metre / GRID) * GRID, len(terrain.line) - 1)
        if stretch != self._stretch:
            self._stretch, self._relief = stretch, terrain.around(stretch)
            near = 2 * GRID + FAR * np.hypot(1, self.fine.size[1] / (2 * self.fine.fx))
            reach = np.linalg.norm(self.scene.places - terrain.line[stretch], axis=-1) < near
            self._feet = [None] * len(reach)
            for k in np.flatnonzero(reach):
                item = self.scene.objects[k]
                self._feet[k] = self._relief.at(*(item.corners if isinstance(item, Box) else item.foot).T)

    def _ground_depth(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One over the ground's depth at each pixel, and the row of its upper end in each column.

        In each of some columns the ground is looked up at all depths and projected; between them one over the depth
        is linear in row and column, exactly so on a plane.
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
        # The far end stays a little green: a horizon as bright as the haze would look like water.
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

    def _pixels(self, points: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels and depths of points of the world, ``[..., 3]``."""
        local = (points - pose[:, 3]) @ pose[:, :3]
        depth = local[..., 2]
        scaled = local[..., :2] / np.maximum(depth, 0.05)[..., None]
        return scaled * [self.fine.fx, self.fine.fy] + [self.fine.cx, self.fine.cy], depth

    def _shown(self, region: tuple[int, int, int, int], depth: float) -> np.ndarray | None:
        """Where no crest of the road hides what is at a depth, uint8; None for everywhere."""
        if not self._hides:
            return None
        x0, y0, x1, y1 = region
        nearer = self._inverse[y0:y1, x0:x1] > 1 / depth * 1.1
        ground = np.arange(y0, y1)[:, None] >= self._top[x0:x1]
        return (~(nearer & ground)).astype(np.uint8)

    def _box(self, picture: np.ndarray, box: Box, feet: np.ndarray, pose: np.ndarray) -> None:
        corners = np.column_stack([box.corners[:, 0], feet, box.corners[:, 1]])
        roof = feet.mean() - box.height
        heads = corners.copy()
        heads[:, 1] = roof
        view = box.corners - pose[[0, 2], 3]
        depths = np.minimum(*(((points - pose[:, 3]) @ pose[:, 2]) for points in (corners, heads)))
        sides = []
        for k in range(4):
            n = (k + 1) % 4
            hidden = view[k, 0] * view[n, 1] - view[k, 1] * view[n, 0] >= 0  # seen from behind
            if not hidden and max(depths[k], depths[n]) > NEAR:
                sides.append((k, n))
        for k, n in sorted(sides, key=lambda side: -depths[list(side)].sum()):
            span = depths[n] - depths[k]
            start = (NEAR - depths[k]) / span if depths[k] < NEAR else 0.0
            end = (NEAR - depths[k]) / span if depths[n] < NEAR else 1.0
            part = np.array([start, end, end, start])[:, None]
            points = np.concatenate(
                [
                    heads[k] + part[:2] * (heads[n] - heads[k]),
                    corners[k] + part[2:] * (corners[n] - corners[k]),
                ]
            )
            quad, depth = self._pixels(points, pose)
            face = box.faces[k]
            rows, columns = face[0].shape[:2]
            across = box.corners[n] - box.corners[k]
            length = np.linalg.norm(across)
            if box.pixels_per_metre is not None:
                columns = min(columns, length * box.pixels_per_metre)
                rows = min(rows, box.height * box.pixels_per_metre)
            tall = (points[:, 1] - roof) * rows / box.height  # the foot follows the slope
            source = np.column_stack([part * columns, tall]) - 0.5
            light = 1 + float(self._sun @ (across[1], -across[0])) / length
            self._warp_quad(picture, face, source, quad, float(depth.min()), light)

    def _warp_quad(self, picture, face, source, quad, depth: float, light: float) -> None:
        """Lay a texture over a quadrilateral of the picture."""
        region = _region(*quad.min(0), *quad.max(0), picture.shape)
        if region is None:
            return
        x0, y0, x1, y1 = region
        area = max(cv2.contourArea(quad.astype(np.float32)), 1e-3)
        level = _level(np.sqrt(cv2.contourArea(source.astype(np.float32)) / area), len(face))
        shifted = (quad - [x0, y0]).astype(np.float32)
        homography = cv2.getPerspectiveTransform((source / 2.0**level).astype(np.float32), shifted)
        size = (x1 - x0, y1 - y0)
        piece = cv2.warpPerspective(
            face[level], homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        clear = np.float32(np.exp(-depth / HAZE))
        mist = np.float32(self.scene.haze) * (1 - clear)
        piece = np.minimum(piece * (clear * np.float32(light)) + mist, 255).astype(np.uint8)
        mask = np.zeros(size[::-1], np.uint8)
        corners = np.round(np.clip(shifted, -8000, 8000) * 16).astype(np.int32)
        cv2.fillConvexPoly(mask, corners, 255, cv2.LINE_8, 4)
        shown = self._shown(region, depth)
        cv2.copyTo(piece, mask if shown is None else mask * shown, picture[y0:y1, x0:x1])

    def _card(self, picture: np.ndarray, card: Card, foot: float, depth: float, pose: np.ndarray) -> None:
        if depth < 2 * NEAR:
            return
        base = np.array([card.foot[0], foot, card.foot[1]])
        right = pose[:, 0] * [1, 0, 1]
        half = right / np.linalg.norm(right) * card.width / 2
        points = np.stack([base - half, base + half, base - half - [0, card.height, 0]])
        (left, far, head), _ = self._pixels(points, pose)
        quad = np.stack([left, far, head, head + far - left])
        region = _region(*quad.min(0), *quad.max(0), picture.shape)
        if region is None:
            return
        x0, y0, x1, y1 = region
        rows, columns = card.sprite[0].shape[:2]
        matrix = np.column_stack([(far - left) / columns, (left - head) / rows, head - [x0, y0]])
        level = _level(1 / np.sqrt(abs(np.linalg.det(matrix[:, :2]))), len(card.sprite))
        matrix[:, :2] *= 2.0**level
        piece = cv2.warpAffine(card.sprite[level], matrix, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR)
        shown = self._shown(region, depth)
        if shown is not None:
            piece = piece * shown[..., None]
        alpha = piece[..., 3:] * np.float32(1 / 255)
        clear = np.float32(np.exp(-depth / HAZE))
        colour = piece[..., :3] * clear + np.float32(self.scene.haze) * ((1 - clear) * alpha)
        view = picture[y0:y1, x0:x1]
        view[:] = view * (1 - alpha) + colour

    def _car_shadow(self, picture: np.ndarray, box: Box, pose: np.ndarray) -> None:
        """Darken the ground under a moving car."""
        middle = box.corners.mean(0)
        corners = middle + (box.corners - middle) * [1.08, 1.08]
        points = np.column_stack([corners[:, 0], self._relief.at(*corners.T), corners[:, 1]])
        quad, depth = self._pixels(points, pose)
        if depth.min() < NEAR or depth.max() > FAR:
            return
        region = _region(*quad.min(0), *quad.max(0), picture.shape)
        if region is None:
            return
        x0, y0, x1, y1 = region
        mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
        cv2.fillConvexPoly(mask, np.round((quad - [x0, y0]) * 16).astype(np.int32), 255, cv2.LINE_8, 4)
        shown = self._shown(region, float(depth.min()))
        view = picture[y0:y1, x0:x1]
        cv2.copyTo(cv2.convertScaleAbs(view, alpha=0.45), mask if shown is None else mask * shown, view)


def _hats(pixels: int) -> np.ndarray:
    """Weights that interpolate linearly between pixels 0, STEP, 2 STEP ...: ``[nodes, pixels]``."""
    nodes = np.arange(0, pixels + STEP, STEP)
    return np.maximum(1 - np.abs(np.arange(pixels) - nodes[:, None]) / STEP, 0).astype(np.float32)


def _region(left, top, right, bottom, shape) -> tuple[int, int, int, int] | None:
    x0, y0 = max(int(np.floor(left)), 0), max(int(np.floor(top)), 0)
    x1, y1 = min(int(np.ceil(right)) + 1, shape[1]), min(int(np.ceil(bottom)) + 1, shape[0])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def _level(minification: float, levels: int) -> int:
    return int(np.clip(np.round(np.log2(max(minification, 1e-6))), 0, levels - 1))
