"""Draws objects and traffic: walls as planes warped by their homographies, trees and poles as cards."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from torch_denkf.applications.car.street import raster
from torch_denkf.applications.car.street.camera import Camera
from torch_denkf.applications.car.street.scene import Box, Card, Scene
from torch_denkf.applications.car.street.terrain import Relief

HAZE = 140.0  # m: distance at which haze absorbs 63 %
NEAR, FAR = 1.0, 120.0  # m
FADE = 25.0  # m before FAR at which objects start to become transparent

Shown = Callable[[tuple[int, int, int, int], float], "np.ndarray | None"]


class Things:
    """Draws the objects and the traffic of a scene.

    Args:
        scene: the scene.
        camera: the camera of the images.
    """

    def __init__(self, scene: Scene, camera: Camera):
        self.scene, self.camera = scene, camera
        self.corners = np.array([_corners(item) for item in scene.objects]).reshape(-1, 4, 2)
        self.feet = np.zeros(self.corners.shape[:2])
        self._sun = scene.sun / max(np.linalg.norm(scene.sun), 1e-9) * (1 - scene.shade)

    def settle(self, relief: Relief, place: np.ndarray) -> None:
        """Places nearby objects at (x, z) on the ground."""
        self.relief = relief
        sight = FAR * np.hypot(1, self.camera.size[1] / (2 * self.camera.fx)) + 40
        near = np.linalg.norm(self.scene.places - place, axis=-1) < sight
        self.feet[near] = relief.at(self.corners[near, :, 0], self.corners[near, :, 1])

    def draw(self, picture: np.ndarray, pose: np.ndarray, cars: list[Box], shown: Shown) -> None:
        """Draws all visible objects.

        Args:
            picture: BGR image to draw into.
            pose: camera-to-world matrix, ``[3, 4]``.
            cars: the traffic.
            shown: returns the mask of a region's pixels in which the ground does not occlude an object at a depth; None
                for no occlusion.
        """
        items = [*self.scene.objects, *cars]
        if not items:
            return
        corners = np.concatenate([self.corners, np.array([car.corners for car in cars]).reshape(-1, 4, 2)])
        relative = corners.mean(1) - pose[[0, 2], 3]
        depth, aside = relative @ pose[[0, 2], 2], relative @ pose[[0, 2], 0]
        seen = (depth > -10) & (depth < FAR) & (np.abs(aside) < 15 + depth * self.camera.size[1] / (2 * self.camera.fx))
        order = np.flatnonzero(seen)
        order = order[np.argsort(depth[order], kind="stable")]  # the nearest first
        items, corners, middle = [items[k] for k in order], corners[order], depth[order]
        fixed = order < len(self.feet)
        feet = np.empty(corners.shape[:2])
        feet[fixed] = self.feet[order[fixed]]
        feet[~fixed] = self.relief.at(corners[~fixed, :, 0], corners[~fixed, :, 1])
        card = np.array([isinstance(item, Card) for item in items], bool)
        right = pose[[0, 2], 0] / np.linalg.norm(pose[[0, 2], 0])
        half = np.array([item.width / 2 if isinstance(item, Card) else 0.0 for item in items])
        corners = corners + half[:, None, None] * (np.array([-1, 1, 1, -1])[:, None] * right)
        points = np.repeat(np.dstack([corners[..., 0], feet, corners[..., 1]]), 2, 0).reshape(-1, 2, 4, 3)
        points[:, 1, :, 1] = feet.mean(1, keepdims=True) - np.array([item.height for item in items])[:, None]
        pixels, depth = project(self.camera, points, pose)
        for k in np.flatnonzero(~fixed):
            self._car_shadow(picture, cars[order[k] - len(self.feet)], pose, shown)
        ahead = depth.min((1, 2)) > NEAR
        gone = raster.hidden(pixels, ahead, ahead & ~card & (middle < FAR - FADE - 12), picture.shape)
        gone |= card & (middle < 2 * NEAR)
        for k in np.flatnonzero(~gone)[::-1]:
            if card[k]:
                self._card(picture, items[k], pixels[k], float(middle[k]), shown)
            else:
                self._box(picture, items[k], points[k], pixels[k], depth[k].min(0), pose, shown)

    def _box(self, picture, box: Box, points, pixels, depths, pose, shown: Shown) -> None:
        feet, heads = points
        view, roof = box.corners - pose[[0, 2], 3], heads[0, 1]
        sides = []
        for k in range(4):
            n = (k + 1) % 4
            turned = view[k, 0] * view[n, 1] - view[k, 1] * view[n, 0] >= 0  # seen from behind
            if not turned and max(depths[k], depths[n]) > NEAR:
                sides.append((k, n))
        for k, n in sorted(sides, key=lambda side: -depths[side[0]] - depths[side[1]]):
            start, end, first, last = 0.0, 1.0, feet[k], feet[n]
            if min(depths[k], depths[n]) > NEAR:
                quad, depth = np.stack([pixels[1, k], pixels[1, n], pixels[0, n], pixels[0, k]]), depths[[k, n]].min()
            else:  # cut where it comes too near
                cut = (NEAR - depths[k]) / (depths[n] - depths[k])
                start, end = (cut, 1.0) if depths[k] < NEAR else (0.0, cut)
                first, last = feet[k] + start * (feet[n] - feet[k]), feet[k] + end * (feet[n] - feet[k])
                edge = np.stack([first, last, last, first])
                edge[:2, 1] = roof
                quad, depth = project(self.camera, edge, pose)
                depth = depth.min()
            face = box.faces[k]
            rows, columns = face[0].shape[:2]
            across = box.corners[n] - box.corners[k]
            length = np.hypot(*across)
            if box.pixels_per_metre is not None:
                columns = min(columns, length * box.pixels_per_metre)
                rows = min(rows, box.height * box.pixels_per_metre)
            left, far, scale = start * columns, end * columns, rows / box.height
            # The foot follows the slope.
            low, high = (last[1] - roof) * scale, (first[1] - roof) * scale
            source = np.array([[left, 0.0], [far, 0.0], [far, low], [left, high]]) - 0.5
            light = 1 + float(self._sun[0] * across[1] - self._sun[1] * across[0]) / length
            self._wall(picture, face, source, quad, float(depth), light, shown)

    def _wall(self, picture, face, source, quad, depth: float, light: float, shown: Shown) -> None:
        region = raster.region(quad, picture.shape)
        if region is None:
            return
        x0, y0, x1, y1 = region
        area = max(cv2.contourArea(quad.astype(np.float32)), 1e-3)
        level = raster.level(np.sqrt(cv2.contourArea(source.astype(np.float32)) / area), len(face))
        shifted = (quad - [x0, y0]).astype(np.float32)
        homography = cv2.getPerspectiveTransform((source / 2.0**level).astype(np.float32), shifted)
        size = (x1 - x0, y1 - y0)
        piece = cv2.warpPerspective(
            face[level], homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        clear = np.float32(np.exp(-depth / HAZE))
        mist = np.float32(self.scene.haze) * (1 - clear)
        piece = np.minimum(piece * (clear * np.float32(light)) + mist, 255).astype(np.uint8)
        fade = (FAR - depth) / FADE
        if fade < 1:
            piece = cv2.addWeighted(piece, max(fade, 0.0), picture[y0:y1, x0:x1], 1 - max(fade, 0.0), 0)
        mask = np.zeros(size[::-1], np.uint8)
        corners = np.round(np.clip(shifted, -8000, 8000) * 16).astype(np.int32)
        cv2.fillConvexPoly(mask, corners, 255, cv2.LINE_8, 4)
        part = shown(region, depth)
        cv2.copyTo(piece, mask if part is None else mask * part, picture[y0:y1, x0:x1])

    def _card(self, picture, card: Card, pixels, depth: float, shown: Shown) -> None:
        (left, far), head = pixels[0, :2], pixels[1, 0]
        region = raster.region(np.stack([left, far, head, head + far - left]), picture.shape)
        if region is None:
            return
        x0, y0, x1, y1 = region
        rows, columns = card.sprite[0].shape[:2]
        matrix = np.column_stack([(far - left) / columns, (left - head) / rows, head - [x0, y0]])
        level = raster.level(
            1 / np.sqrt(abs(matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0])), len(card.sprite)
        )
        matrix[:, :2] *= 2.0**level
        piece = cv2.warpAffine(card.sprite[level], matrix, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR)
        part, fade = shown(region, depth), np.float32(min((FAR - depth) / FADE, 1.0))
        piece = piece * (fade if part is None else fade * part[..., None])
        alpha = piece[..., 3:] * np.float32(1 / 255)
        clear = np.float32(np.exp(-depth / HAZE))
        colour = piece[..., :3] * clear + np.float32(self.scene.haze) * ((1 - clear) * alpha)
        view = picture[y0:y1, x0:x1]
        view[:] = view * (1 - alpha) + colour

    def _car_shadow(self, picture, box: Box, pose, shown: Shown) -> None:
        """Darkens the ground under a moving car."""
        middle = box.corners.mean(0)
        corners = middle + 1.08 * (box.corners - middle)
        points = np.column_stack([corners[:, 0], self.relief.at(*corners.T), corners[:, 1]])
        quad, depth = project(self.camera, points, pose)
        region = raster.region(quad, picture.shape)
        if depth.min() < NEAR or depth.max() > FAR - FADE or region is None:
            return
        x0, y0, x1, y1 = region
        mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
        cv2.fillConvexPoly(mask, np.round((quad - [x0, y0]) * 16).astype(np.int32), 255, cv2.LINE_8, 4)
        part = shown(region, float(depth.min()))
        view = picture[y0:y1, x0:x1]
        cv2.copyTo(cv2.convertScaleAbs(view, alpha=0.45), mask if part is None else mask * part, view)


def project(camera: Camera, points: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projects points of the world ``[..., 3]`` to pixels ``[..., 2]`` and depths ``[...]``, at least 5 cm."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = local[..., 2]
    scaled = local[..., :2] / np.maximum(depth, 0.05)[..., None]
    return scaled * [camera.fx, camera.fy] + [camera.cx, camera.cy], depth


def _corners(item: Box | Card) -> np.ndarray:
    return item.corners if isinstance(item, Box) else np.tile(item.foot, (4, 1))
