"""Signs of a camera fault in two images: static occlusions, over- and underexposure."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_denkf._checks import check_count, check_number
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.applications.car.vision.expansion import coarse_cells, focus_of_expansion

__all__ = ["FLOW_SIGNS", "PICTURE_SIGNS", "flow_signs", "picture_signs", "plane_distance", "static_region"]

#: Names of the entries of :func:`picture_signs`.
PICTURE_SIGNS = ("static", "bright", "dark", "exposure")
#: Names of the entries of :func:`flow_signs`.
FLOW_SIGNS = ("plane", "road")

_CELLS = 60  # number of cells across an image
_LEAST_CELLS = 3  # side of the smallest counted region, cells
_LEAST_SIDE = 3  # smallest side of a cell, pixels: smaller ones may be unchanged by chance
_BELOW = 0.08  # tangents below the camera's axis: the road, up to 20 m ahead of KITTI's camera
_STANDING = 0.05  # m: added to distances, so that their ratio is finite at standstill
_WHITE, _BLACK = 250, 5  # grey levels at which a pixel counts as too bright, or too dark


def static_region(previous: np.ndarray, current: np.ndarray, *, noise: int = 0, cells: int = _CELLS) -> np.ndarray:
    """Masks static pixels before a moving camera: dirt on the lens, an occlusion, dead pixels.

    The image is divided into square cells. A cell is static if none of its pixels changed by more than the noise, while
    more than half of the cells did change. Overexposed cells are left out, because an overexposed sky does not change
    either; and so are regions smaller than three by three cells.

    Args:
        previous: grey picture ``[H, W]``, uint8.
        current: the next picture ``[H, W]``, uint8.
        noise: grey levels of image noise, after a median filter over 3 x 3 pixels.
        cells: number of cells across the image.

    Returns:
        ``[H, W]``, bool. All False if half of the image does not change: the camera stands still, or the image is
        uniform.

    Raises:
        ValueError: if the images differ in shape, or a number is out of range.

    Example:
        >>> draw = np.random.default_rng(0).integers(0, 200, (2, 100, 300)).astype(np.uint8)
        >>> draw[:, 40:70, 60:120] = 7  # an occlusion of 6 % of both images
        >>> region = static_region(*draw)
        >>> round(float(region.mean()), 3), bool(region[45:65, 65:115].all())
        (0.057, True)
    """
    check_count("cells", cells)
    check_number("noise", noise, least=0)
    if previous.shape != current.shape or previous.ndim != 2:
        raise ValueError(f"pictures are grey and of one shape [H, W]; got {previous.shape} and {current.shape}")
    previous, current = (cv2.medianBlur(np.ascontiguousarray(image), 3) for image in (previous, current))
    side = max(previous.shape[1] // cells, _LEAST_SIDE)
    change = _largest(cv2.absdiff(previous, current), side)
    same = change <= noise
    if np.median(change) <= noise:
        return np.zeros(previous.shape, bool)
    white = _largest(255 - np.minimum(previous, current), side) <= 255 - _WHITE
    least = np.ones((_LEAST_CELLS, _LEAST_CELLS), np.uint8)
    found = np.asarray(cv2.morphologyEx((same & ~white).astype(np.uint8), cv2.MORPH_OPEN, least))
    height, width = previous.shape
    return found.repeat(side, 0).repeat(side, 1)[:height, :width].astype(bool)


def picture_signs(previous: np.ndarray, current: np.ndarray, *, noise: int = 0) -> np.ndarray:
    """Returns signs of a fault that are small for two images of a working camera, and large for a failing one.

    An :class:`torch_denkf.monitoring.InnovationMonitor` monitors them together with the innovations, and a
    :class:`torch_denkf.monitoring.SignGate` rejects readings by them; both calibrate their limits on clean data.

    ============ ======================================================================================================
    entry        content
    ============ ======================================================================================================
    ``static``   share of static pixels although the camera moves, see :func:`static_region`
    ``bright``   share of white pixels, in the image with more of them
    ``dark``     share of black pixels, in the image with more of them
    ``exposure`` absolute logarithm of the ratio of the images' mean brightness
    ============ ======================================================================================================

    Args:
        previous: grey picture ``[H, W]``, uint8.
        current: the next picture ``[H, W]``, uint8.
        noise: see :func:`static_region`.

    Returns:
        ``[4]``, float32, in the order of ``PICTURE_SIGNS``.

    Example:
        >>> street = np.random.default_rng(0).integers(40, 200, (100, 300)).astype(np.uint8)
        >>> [round(sign, 1) for sign in picture_signs(street, np.zeros_like(street)).tolist()]
        [0.0, 0.0, 1.0, 4.8]
    """
    both = (previous, current)
    means = [float(image.mean()) + 1 for image in both]  # plus one grey level, so that the logarithm is finite
    return np.array(
        [
            static_region(previous, current, noise=noise).mean(),
            max((image >= _WHITE).mean() for image in both),
            max((image <= _BLACK).mean() for image in both),
            abs(math.log(means[1] / means[0])),
        ],
        np.float32,
    )


def _largest(values: np.ndarray, side: int) -> np.ndarray:
    """Returns the largest value in each cell, including those at the right and lower border."""
    height, width = values.shape
    padded = np.pad(values, ((0, -height % side), (0, -width % side)))
    return padded.reshape(padded.shape[0] // side, side, -1, side).max((1, 3))


@torch.no_grad()
def plane_distance(flow: Tensor, *, height: float = KITTI_HEIGHT) -> Tensor:
    r"""Estimates the distance moved over a road from the flow below the horizon, as a cross-check.

    A point of the road at p, in tangents, has the depth :math:`h / y`, where y is its distance below the focus of
    expansion e.

    A motion of the camera by d shifts it by :math:`d\, y / h\, (p - e)`, in addition to the turn. Each cell of the flow
    gives a distance, and their median is robust if a car occludes the lane, on which :func:`road_correlation` depends.
    It is biased, because dense flow is too small on the near road: by 11 % on rendered drives, with a scatter of 5 %.

    Args:
        flow: ``[N, 3, 25, 79]``, see :func:`torch_denkf.applications.car.vision.flow.coarse_flow`.
        height: height of the camera over the road, in m.

    Returns: Distances ``[N]`` in m, float32.

    Example:
        Flow of a road plane under a camera that moves by 1.2 m.

        >>> x, y = coarse_cells()
        >>> flow = torch.stack([x, y, 0 * x]) * (1.2 / 1.65 * y.clamp_min(0))
        >>> plane_distance(flow.view(1, 3, 25, 79)).round(decimals=2)
        tensor([1.2000])
    """
    fit = focus_of_expansion(flow)
    x, y = coarse_cells().to(flow.device, torch.float32)
    left, up, around = fit.turn.float().unsqueeze(-1).unbind(1)
    across, along = left * (1 + x * x) + up * x * y - around * y, left * x * y + up * (1 + y * y) + around * x
    turned = torch.stack([across, along], 1)
    ray = torch.stack([x, y]) - fit.focus.float().unsqueeze(-1)
    nearness = ((flow[:, :2].flatten(2).float() - turned) * ray).sum(1) / ray.square().sum(1)
    below = y > _BELOW
    return (nearness * height / ray[:, 1])[:, below].median(1).values


def flow_signs(plane: Tensor, road: Tensor, distance: Tensor) -> Tensor:
    """Returns signs of an occluded road, such as by the back of a car close ahead.

    ============ ======================================================================================================
    entry        content
    ============ ======================================================================================================
    ``plane``    absolute logarithm of the ratio of the distance by all flow to the sensor's distance
    ``road``     1 minus the largest correlation of the road, see :func:`road_correlation`
    ============ ======================================================================================================

    Args:
        plane: see :func:`plane_distance`, ``[N]``.
        road: ``[N, 13, 69]``.
        distance: reading of the sensor, ``[N]`` in m.

    Returns:
        ``[N, 2]``, in the order of ``FLOW_SIGNS``.

    Example:
        >>> flow_signs(torch.tensor([1.0]), torch.ones(1, 13, 69), torch.tensor([0.3])).round(decimals=1)
        tensor([[1.1000, 0.0000]])
    """
    known, said = (value.float().clamp_min(0) + _STANDING for value in (plane, distance))
    return torch.stack([(known / said).log().abs(), 1 - road.float().amax((1, 2))], -1)
