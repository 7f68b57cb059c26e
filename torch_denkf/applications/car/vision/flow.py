"""Dense optical flow between two images, by OpenCV's DIS (Kroeger et al. 2016, arXiv:1603.03590)."""

from __future__ import annotations

import cv2
import numpy as np

from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE

__all__ = ["coarse_flow", "dense_flow", "median_turn"]

_RESIDUAL = 40.0  # grey levels that count as a complete mismatch


def dense_flow(previous: np.ndarray, current: np.ndarray, camera: CanonicalCamera) -> np.ndarray:
    """Computes the dense optical flow: the motion of every pixel of ``current`` since ``previous``.

    Args:
        previous: canonical image ``[H, W]``, uint8.
        current: canonical image ``[H, W]``, uint8.
        camera: camera of both.

    Returns: ``[H, W, 2]``, float32: motion to the right and down, in units of the focal length (tangents).
    """
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    previous, current = (np.ascontiguousarray(image) for image in (previous, current))  # OpenCV takes no views
    # Computed from the current image, so that the vectors are on its grid.
    flow = dis.calc(current, previous, None)  # type: ignore[call-overload]  # cv2 does not say that None is one to make
    return -flow / camera.focal


def coarse_flow(flow: np.ndarray, previous: np.ndarray, current: np.ndarray, camera: CanonicalCamera) -> np.ndarray:
    """Returns means of the flow over a coarse grid, and its mismatch as a measure of confidence.

    Args:
        flow: result of :func:`dense_flow`, ``[H, W, 2]``.
        previous: ``[H, W]``, uint8.
        current: ``[H, W]``, uint8.
        camera: camera of both.

    Returns: ``FLOW_SHAPE``, float32: motion to the right, motion down (tangents), and the difference of ``previous``,
    warped by the flow, from ``current``: 1 for 40 grey levels or more.
    """
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    pixels = flow * camera.focal
    moved = cv2.remap(
        previous, columns - pixels[..., 0], rows - pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    mismatch = np.minimum(cv2.absdiff(moved, current), _RESIDUAL).astype(np.float32) / _RESIDUAL
    _, height, width = FLOW_SHAPE
    grid = cv2.resize(np.dstack([flow, mismatch]), (width, height), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(grid.transpose(2, 0, 1))


def median_turn(flow: np.ndarray) -> tuple[float, float]:
    """Returns the turn to the left and up: the median flow straight ahead, where objects are far away.

    Args:
        flow: ``[H, W, 2]`` or coarser, in tangents.

    Returns:
        The angles to the left and up, in rad.
    """
    height, width = flow.shape[:2]
    ahead = flow[int(0.33 * height) : int(0.5 * height), int(0.375 * width) : int(0.625 * width)]
    return float(np.median(ahead[..., 0])), float(np.median(ahead[..., 1]))
