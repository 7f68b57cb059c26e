"""Motion over the road: correlates two images, projected on the ground, along the direction of travel.

Dense optical flow is too small on the near road, where motion is large and texture is poor; but the ground plane gives
pixels a metric scale. Each image is projected on the plane under the car, for several pitches of the camera, and the
older one is shifted against the newer. The pitch and the distance with the largest correlation give the motion, without
a learned part; normalised correlation ignores brightness and contrast. The flow sensor reads the whole table of
correlations.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT, CanonicalCamera
from torch_denkf.applications.car.vision.shapes import CELL, ROAD_PITCHES, ROAD_SHAPE, ROAD_SHIFTS

__all__ = ["road_correlation"]

_LENGTH, _HALF_WIDTH, _LANES = 7.0, 3.0, 32  # m, m, columns: the compared piece of road
_NEAREST = 4.0  # m: a nearer cell covers many pixels


def road_correlation(
    previous: np.ndarray,
    current: np.ndarray,
    camera: CanonicalCamera,
    turn: tuple[float, float],
    height: float = KITTI_HEIGHT,
) -> np.ndarray:
    """Returns the correlation of the road in two images, for each pitch and each distance travelled.

    Args:
        previous: canonical image ``[H, W]``, uint8.
        current: canonical image ``[H, W]``, uint8.
        camera: camera of both.
        turn: turn of the camera to the left and up between the images, in rad; see
            :func:`torch_denkf.applications.car.vision.flow.median_turn`.
        height: height of the camera over the road, in m.

    Returns: ``ROAD_SHAPE`` = (pitches, distances), float32 in [-1, 1].
    """
    previous, current = (cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float32) for image in (previous, current))
    left, up = turn
    first, count = round(ROAD_SHIFTS[0] / CELL), len(ROAD_SHIFTS)
    table = np.empty(ROAD_SHAPE, np.float32)
    for row, pitch in enumerate(ROAD_PITCHES):
        nearest = _nearest(camera, float(pitch), height) - ROAD_SHIFTS[0]
        cells = round(_LENGTH / CELL)
        ahead = nearest + np.arange(cells) * CELL
        # Each view is rotated by half of the turn, so that the motion between them is straight ahead.
        now = _plan(current, camera, pitch, height, ahead, -left / 2, 0.0)
        before = nearest + (first + np.arange(cells + count - 1)) * CELL
        then = _plan(previous, camera, pitch, height, before, left / 2, up)
        table[row] = _slide(now, then, (1 / ahead).astype(np.float32))
    return table


@lru_cache(maxsize=256)
def _nearest(camera: CanonicalCamera, pitch: float, height: float) -> float:
    """Returns the distance at which the road enters the image, in m ahead."""
    bottom = (camera.height - 4) / 2 / camera.focal
    return max(height / np.tan(np.arctan(bottom) - pitch), _NEAREST)


def _plan(image, camera, pitch, height, ahead, left, up) -> np.ndarray:
    """Maps the road to a view from above, ``[len(ahead), lanes]``, of a camera turned by ``left`` and ``up``."""
    lanes = np.linspace(-_HALF_WIDTH, _HALF_WIDTH, _LANES)
    right = lanes * np.cos(left) - ahead[:, None] * np.sin(left)
    forward = lanes * np.sin(left) + ahead[:, None] * np.cos(left)
    depth = forward * np.cos(pitch) - height * np.sin(pitch)
    down = height * np.cos(pitch) + forward * np.sin(pitch)
    columns, rows = camera.pixels(right / depth, down / depth - up)
    plan = cv2.remap(image, columns, rows, cv2.INTER_LINEAR)
    # Slowly varying shading would match at any distance.
    return plan - cv2.GaussianBlur(plan, (0, 0), sigmaX=3.2, sigmaY=10)


def _slide(now: np.ndarray, then: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Returns the weighted normalised correlation of ``now`` with every window of its length in ``then``."""
    cells = len(now)
    weight = weight / weight.sum() / now.shape[1]
    now = now - (weight @ now).sum()
    own = (weight @ now**2).sum()
    windows = np.lib.stride_tricks.sliding_window_view(then, cells, axis=0)  # [shifts, lanes, cells]
    product = np.tensordot(windows, (weight[:, None] * now).T, axes=2)
    total, squares = then.sum(1), (then**2).sum(1)
    mean = np.lib.stride_tricks.sliding_window_view(total, cells) @ weight
    variance = np.lib.stride_tricks.sliding_window_view(squares, cells) @ weight - mean**2
    # One hundredth of a squared grey level: images without any texture correlate to zero, not to noise.
    return product / np.sqrt(own * np.maximum(variance, 0) + 1e-2)
