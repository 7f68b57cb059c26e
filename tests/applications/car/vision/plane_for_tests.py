"""An oracle for image motion: exact views of a textured plane under a textured sky, by casting rays.

Shares nothing with the library: rotation matrices and intersections, no plans and no small angles.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

HEIGHT = 1.65  # m over the plane


@lru_cache
def random_texture(seed: int, blur: float = 1.5) -> np.ndarray:
    """Grey levels around 128 with a standard deviation of 35, ``[1024, 1024]``, that repeat without a seam."""
    noise = np.random.default_rng(seed).standard_normal((1024, 1024))
    smooth = cv2.GaussianBlur(np.pad(noise, 16, mode="wrap"), (0, 0), blur)[16:-16, 16:-16]
    return 128 + 35 * smooth / smooth.std()


def as_image(values: np.ndarray) -> np.ndarray:
    """Rounded to grey levels."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def rotation(left: float, up: float) -> np.ndarray:
    """From the axes (right, down, ahead) of a camera that turned to the left, and then up, to the world's."""
    turned = [[np.cos(left), 0, -np.sin(left)], [0, 1, 0], [np.sin(left), 0, np.cos(left)]]
    nodded = [[1, 0, 0], [0, np.cos(up), -np.sin(up)], [0, np.sin(up), np.cos(up)]]
    return np.array(turned) @ np.array(nodded)


def render(size, calibration, *, position=(0.0, 0.0), left=0.0, up=0.0, samples=3) -> np.ndarray:
    """Draws what a camera at ``position`` (x to the right and z ahead, in m) sees, uint8 ``[H, W]``.

    The plane's details are about 0.1 m wide, those of the sky, which is infinitely far, 0.015 rad. Beyond 30 m the
    plane, finer than a pixel there, fades to grey.
    """
    (rows, columns), (fx, fy, cx, cy) = size, calibration
    parts = (np.arange(samples) + 0.5) / samples - 0.5
    u, v = np.meshgrid((np.arange(columns)[:, None] + parts).ravel(), (np.arange(rows)[:, None] + parts).ravel())
    right, down, ahead = np.moveaxis(
        np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1) @ rotation(left, up).T, -1, 0
    )
    reach = HEIGHT / np.maximum(down, 1e-3)
    plane = _lookup(random_texture(1), (position[0] + reach * right) / 0.06, (position[1] + reach * ahead) / 0.06)
    plane = plane + np.clip((reach * ahead - 30) / 30, 0, 1) * (128 - plane)
    sky = _lookup(random_texture(2), np.arctan2(right, ahead) / 0.01, down / np.hypot(right, ahead) / 0.01)
    image = np.where(down > 1e-3, plane, sky)
    return as_image(image.reshape(rows, samples, columns, samples).mean((1, 3)))


def pair(size, calibration, *, distance=0.0, turn=0.0, up=0.0, nod=0.0) -> tuple[np.ndarray, np.ndarray]:
    """Returns two views: the car drives an arc of chord ``distance`` and turns by ``turn`` to the left.

    The camera looks up by ``up`` in the second one, and by ``nod`` less in the first.
    """
    arrived = (-distance * np.sin(turn / 2), distance * np.cos(turn / 2))
    return _first(size, calibration, up - nod), render(size, calibration, position=arrived, left=turn, up=up)


@lru_cache(maxsize=16)
def _first(size, calibration, up):
    return render(size, calibration, up=up)


def _lookup(texture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear, periodic."""
    side = len(texture)
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = x - i, y - j
    i, j, after_i, after_j = i % side, j % side, (i + 1) % side, (j + 1) % side
    near = (1 - a) * texture[j, i] + a * texture[j, after_i]
    return (1 - b) * near + b * ((1 - a) * texture[after_j, i] + a * texture[after_j, after_i])
