"""Extrapolates images and flow over an occlusion from its surroundings."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.applications.car.vision.expansion import focus_of_expansion
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE

__all__ = ["continue_flow", "continue_picture"]

_RIM = 8  # pixels around an occlusion with disturbed flow
_PICTURE_RIM = 2  # pixels around an occlusion with mixed grey values
_NEAR = 0.02  # rad around the focus, where the flow has no information about depth
_NEAREST = 2.0  # largest ratio of the flow along a ray to the distance from the focus
_REACH = 3  # pixels: radius of the inpainting


def continue_picture(image: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Returns a canonical image ``[H, W]``, uint8, without the edges of an occlusion ``[H, W]``, bool."""
    return cv2.inpaint(image, grown(hidden, _PICTURE_RIM), _REACH, cv2.INPAINT_TELEA)


def continue_flow(
    flow: np.ndarray, coarse: np.ndarray, hidden: np.ndarray, camera: CanonicalCamera
) -> tuple[np.ndarray, np.ndarray]:
    r"""Returns the optical flow extrapolated over an occlusion, from its surroundings and the camera's motion.

    The flow of a point p is that of the turn, plus :math:`\rho(p) (p - e)` with the focus of expansion e and an inverse
    distance :math:`\rho`. Turn and focus are fitted to the visible flow. The inverse distance is inpainted from the
    surroundings; its errors have little effect near the focus, where flow is small.

    Args:
        flow: result of :func:`torch_denkf.applications.car.vision.flow.dense_flow`, ``[H, W, 2]``.
        coarse: the same with its mismatch, see :func:`torch_denkf.applications.car.vision.flow.coarse_flow`:
            ``FLOW_SHAPE``.
        hidden: mask of the occlusion, ``[H, W]``, bool.
        camera: canonical camera of the images.

    Returns:
        The flow ``[H, W, 2]``, and the coarse flow's mismatch, inpainted, too, ``[25, 79]``.
    """
    hole = grown(hidden, _RIM)
    _, height, width = FLOW_SHAPE
    cells = (cv2.resize(hole.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0).astype(np.uint8)
    seen = coarse.copy()
    seen[2][cells > 0] = 1  # a mismatch of 1 takes a cell out of the fit
    fit = focus_of_expansion(torch.from_numpy(seen).unsqueeze(0))
    left, up, around = fit.turn[0].numpy()
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    x, y = ((value - (side - 1) / 2) / camera.focal for value, side in ((columns, camera.width), (rows, camera.height)))
    turned = np.dstack([left * (1 + x * x) + up * x * y - around * y, left * x * y + up * (1 + y * y) + around * x])
    ray = np.dstack([x, y]) - fit.focus[0].numpy()
    square = np.maximum((ray**2).sum(-1), _NEAR**2)
    nearness = ((ray * (flow - turned)).sum(-1) / square).clip(0, _NEAREST).astype(np.float32)
    nearness = cv2.inpaint(nearness, hole, _REACH, cv2.INPAINT_NS)
    whole = np.where(hole[..., None] > 0, turned + nearness[..., None] * ray, flow).astype(np.float32)
    return whole, cv2.inpaint(np.ascontiguousarray(coarse[2]), cells, _REACH, cv2.INPAINT_NS)


def grown(hidden: np.ndarray, rim: int) -> np.ndarray:
    """Dilates the mask of occluded pixels ``[H, W]``, bool, by a rim of so many pixels; returns uint8."""
    return cv2.dilate(hidden.astype(np.uint8), np.ones((2 * rim + 1, 2 * rim + 1), np.uint8))
