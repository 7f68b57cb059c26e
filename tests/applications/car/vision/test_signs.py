"""Signs of a failing camera, against pictures and flows whose signs are known."""

import math

import cv2
import numpy as np
import pytest
import torch

from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.applications.car.vision.expansion import coarse_cells
from torch_denkf.applications.car.vision.flow import coarse_flow
from torch_denkf.applications.car.vision.hidden import continue_flow
from torch_denkf.applications.car.vision.signs import (
    FLOW_SIGNS,
    PICTURE_SIGNS,
    flow_signs,
    picture_signs,
    plane_distance,
    static_region,
)

cv2.setNumThreads(1)
HEIGHT = 1.65


def changing(pictures=2, size=(100, 300), seed=0):
    return np.random.default_rng(seed).integers(20, 230, (pictures, *size)).astype(np.uint8)


def covered(images, grey=0):
    images = np.array(images)
    images[:, 30:70, 120:180] = grey
    return images


@pytest.mark.parametrize("grey", [0, 90])
def test_static_occlusion_is_detected_and_nothing_else(grey):
    region = static_region(*covered(changing(), grey))
    expected = np.zeros((100, 300), bool)
    expected[30:70, 120:180] = True  # whole cells of five pixels
    # The median over 3 x 3 pixels takes no more than the corners' cells.
    assert (region & ~expected).sum() == 0
    assert region.sum() >= expected.sum() - 4 * 25


def test_standstill_white_sky_and_speck_are_no_fault():
    one, other = changing()
    assert not static_region(one, one).any()
    assert not static_region(*covered([one, other], 255)).any()
    speck = np.array([one, other])
    speck[:, 40:50, 100:110] = 0  # two cells by two
    assert not static_region(*speck).any()


def test_signs_are_shares_and_a_ratio():
    street = np.full((100, 300), 99, np.uint8)
    street[:, ::2] = 101
    signs = dict(zip(PICTURE_SIGNS, picture_signs(street, np.zeros_like(street)), strict=True))
    assert signs["dark"] == 1
    assert signs["bright"] == 0
    assert signs["exposure"] == pytest.approx(math.log(101))  # a mean of 100, and one more
    half = street.copy()
    half[:25] = 255
    assert picture_signs(half, street)[PICTURE_SIGNS.index("bright")] == pytest.approx(0.25)
    assert picture_signs(street, half)[PICTURE_SIGNS.index("bright")] == pytest.approx(0.25)


def plane_flow(distance, turn=(0.0, 0.0, 0.0), focus=(0.0, 0.0)):
    """Returns the flow of a level road, and of a far wall above it."""
    x, y = coarse_cells()
    left, up, around = turn
    inverse = (y - focus[1]).clamp_min(0.02) / HEIGHT
    moved = distance * inverse * torch.stack([x - focus[0], y - focus[1]])
    turned = torch.stack([left * (1 + x * x) + up * x * y - around * y, left * x * y + up * (1 + y * y) + around * x])
    return torch.cat([moved + turned, torch.zeros(1, x.numel())]).view(1, 3, 25, 79)


@pytest.mark.parametrize("distance", [0.3, 1.2, 2.5])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.02, -0.003, 0.004)])
def test_plane_distance_is_independent_of_the_turn(distance, turn):
    found = plane_distance(plane_flow(distance, turn, focus=(0.01, -0.015)), height=HEIGHT)
    assert found.item() == pytest.approx(distance, rel=0.03)


def test_a_car_ahead_hides_the_lane_and_not_the_distance():
    flow = plane_flow(1.0)
    flow[..., 10:, 30:50] = 0.0  # a quarter of what lies below the horizon keeps its place before the camera
    assert plane_distance(flow).item() == pytest.approx(1.0, rel=0.05)


def test_two_distances_that_agree_are_no_sign():
    road = torch.full((3, 13, 69), 0.9)
    signs = flow_signs(torch.tensor([1.0, 0.0, 2.0]), road, torch.tensor([1.0, 0.0, 0.5]))
    plane = signs[:, FLOW_SIGNS.index("plane")]
    assert torch.allclose(plane, torch.tensor([0.0, 0.0, math.log(2.05 / 0.55)]))
    assert torch.allclose(signs[:, FLOW_SIGNS.index("road")], torch.full((3,), 0.1))


@pytest.mark.parametrize("hole", [np.s_[15:45, 60:110], np.s_[5:60, 30:180]])
def test_behind_a_hole_in_a_wall_the_flow_is_known(hole):
    """All is equally far: the inverse distance is one number, and turn and focus tell the rest.

    What hides the wall stands still before the camera. Where it is larger than what is seen, it would be the motion.
    """
    camera = CanonicalCamera(120.0)
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    x = (columns - (camera.width - 1) / 2) / camera.focal
    y = (rows - (camera.height - 1) / 2) / camera.focal
    left, up = 0.02, -0.004
    turned = np.dstack([left * (1 + x * x) + up * x * y, left * x * y + up * (1 + y * y)])
    true = (turned + 0.1 * np.dstack([x - 0.02, y + 0.01])).astype(np.float32)
    hidden = np.zeros(x.shape, bool)
    hidden[hole] = True
    seen = np.where(hidden[..., None], 0.0, true).astype(np.float32)
    empty = np.zeros(x.shape, np.uint8)
    found, mismatch = continue_flow(seen, coarse_flow(seen, empty, empty, camera), hidden, camera)
    assert np.abs(found - true).max() < 1e-3  # a tenth of a pixel, of a turn of two and a half
    assert np.abs(mismatch).max() < 1e-6
