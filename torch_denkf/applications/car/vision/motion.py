"""Computes the flow sensor's inputs from two images."""

from __future__ import annotations

import cv2
import numpy as np

from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT, CanonicalCamera
from torch_denkf.applications.car.vision.exposure import same_exposure
from torch_denkf.applications.car.vision.flow import coarse_flow, dense_flow, median_turn
from torch_denkf.applications.car.vision.hidden import continue_flow, continue_picture
from torch_denkf.applications.car.vision.road import road_correlation

__all__ = ["grey_picture", "image_motion"]


def image_motion(
    previous: np.ndarray,
    current: np.ndarray,
    calibration,
    *,
    height: float = KITTI_HEIGHT,
    hidden: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns coarse optical flow and road correlation between two images of one calibrated camera.

    First a median over 3 x 3 pixels removes single outliers and preserves edges. Then the exposure of the image with
    less contrast is matched to the other's.

    Args:
        previous: grey image ``[H, W]``, uint8.
        current: grey image ``[H, W]``, uint8.
        calibration: (fx, fy, cx, cy) in pixels of the images.
        height: height of the camera over the road, in m.
        hidden: mask of static occlusions, ``[H, W]``, bool, see ``vision.signs.static_region``, over which images and
            flow are extrapolated. ``None`` for none.

    Returns:
        The flow, ``FLOW_SHAPE`` (see :func:`coarse_flow`), and the correlation of the road, ``ROAD_SHAPE`` (see
        :func:`road_correlation`); both float32.

    Examples:
        Equal images have no motion.

        >>> image = np.random.default_rng(0).integers(0, 255, (50, 150)).astype(np.uint8)
        >>> flow, road = image_motion(image, image, (87.0, 86.5, 73.4, 24.8))
        >>> bool(np.abs(flow).max() < 1e-3), flow.shape, road.shape
        (True, (3, 25, 79), (13, 69))
    """
    camera = CanonicalCamera.near(calibration)
    previous, current = (camera.view(cv2.medianBlur(image, 3), calibration) for image in (previous, current))
    previous, current = same_exposure(previous, current)
    hole = None if hidden is None or not hidden.any() else camera.view(hidden.astype(np.uint8), calibration) > 0
    if hole is not None:
        previous, current = (continue_picture(image, hole) for image in (previous, current))
    flow = dense_flow(previous, current, camera)
    if hole is not None:
        flow, mismatch = continue_flow(flow, coarse_flow(flow, previous, current, camera), hole, camera)
    road = road_correlation(previous, current, camera, median_turn(flow), height)
    coarse = coarse_flow(flow, previous, current, camera)
    if hole is not None:
        coarse[2] = mismatch
    return coarse, road


def grey_picture(image: np.ndarray) -> np.ndarray:
    """Converts a picture ``[C, H, W]``, uint8, RGB or grey, to grey ``[H, W]``."""
    return image[0] if len(image) == 1 else cv2.cvtColor(image.transpose(1, 2, 0), cv2.COLOR_RGB2GRAY)
