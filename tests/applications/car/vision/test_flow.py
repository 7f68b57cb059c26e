"""Oracles: textures that are shifted or enlarged by a known amount, and rendered drives whose motion is known."""

import cv2
import numpy as np
import pytest

from tests.applications.car.vision.plane_for_tests import as_image, pair, random_texture
from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.applications.car.vision.flow import coarse_flow, dense_flow, median_turn
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE

cv2.setNumThreads(1)
CAMERAS = [CanonicalCamera(120.0), CanonicalCamera(240.0)]


def cut(texture, camera, column=200, row=200):
    return as_image(texture[row : row + camera.height, column : column + camera.width])


def intrinsics(camera):
    return (camera.height, camera.width), (camera.focal, camera.focal, (camera.width - 1) / 2, (camera.height - 1) / 2)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(("right", "down"), [(0, 0), (3, 0), (-5, 2), (8, -4)])
def test_a_shift_is_found_in_tangents(camera, right, down):
    texture = random_texture(5)
    previous, current = cut(texture, camera), cut(texture, camera, 200 - right, 200 - down)
    flow = dense_flow(previous, current, camera)
    assert flow.shape == (camera.height, camera.width, 2)
    assert flow.dtype == np.float32
    # Away from the border, where content enters, the match is perfect: measured 0.05 pixels at most.
    inside = flow[12:-12, 12:-12] * camera.focal
    np.testing.assert_allclose(inside, np.broadcast_to([right, down], inside.shape), rtol=0, atol=0.1)
    grid = coarse_flow(flow, previous, current, camera)
    assert grid.shape == FLOW_SHAPE
    for channel, pixels in enumerate((right, down)):
        np.testing.assert_allclose(grid[channel, 6:-6, 10:-10], pixels / camera.focal, rtol=0, atol=0.02 / camera.focal)
    # A match that is off by 0.05 pixels differs by up to a grey level: 1/40.
    assert grid[2, 6:-6, 10:-10].max() < 1 / 40
    # The camera turned left where the scene moves right, and up where it moves down.
    np.testing.assert_allclose(median_turn(flow), np.array([right, down]) / camera.focal, rtol=0, atol=1e-4)


@pytest.mark.parametrize("camera", CAMERAS)
def test_flow_vectors_are_located_in_the_current_image(camera):
    """Enlarged by s about the middle, what is at p was at p / s: the vector there is p (1 - 1/s), not p (s - 1)."""
    s, texture = 1.1, random_texture(5, blur=2.5)
    columns, rows = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (camera.width, camera.height)))
    where = [(columns / r + 500, rows / r + 500) for r in (1, s)]
    previous, current = (
        as_image(cv2.remap(texture, *(x.astype(np.float32) for x in xy), cv2.INTER_LINEAR)) for xy in where
    )
    flow = dense_flow(previous, current, camera)[8:-8, 8:-8] * camera.focal
    for channel, place in enumerate((columns[8:-8, 8:-8], rows[8:-8, 8:-8])):
        slope = np.polyfit(place.ravel(), flow[..., channel].ravel(), 1)[0]
        assert slope == pytest.approx(1 - 1 / s, rel=0.01)  # s - 1 is 10 % more
        # DIS is good to a few hundredths of a pixel where it need not extrapolate.
        assert np.median(np.abs(flow[..., channel] - place * (1 - 1 / s))) < 0.06


@pytest.mark.parametrize("camera", CAMERAS)
def test_mismatch_is_the_grey_difference_after_the_flow(camera):
    flow = np.zeros((camera.height, camera.width, 2), np.float32)
    texture = as_image(0.5 * random_texture(5) + 30)

    def mismatch(previous, current, flow=flow):
        return coarse_flow(flow, previous, current, camera)[2]

    previous = cut(texture, camera)
    for levels, expected in ((0, 0.0), (20, 0.5), (40, 1.0), (90, 1.0)):
        np.testing.assert_allclose(mismatch(previous, previous + np.uint8(levels)), expected, atol=1e-6)
        np.testing.assert_allclose(mismatch(previous + np.uint8(levels), previous), expected, atol=1e-6)
    # The right flow (not its opposite) brings the previous image to the current one.
    current, right = cut(texture, camera, 200 - 4, 200 + 3), flow + np.float32([4, -3]) / camera.focal
    assert mismatch(previous, current, right)[5:-5, 5:-5].max() < 1e-3
    assert mismatch(previous, current, -right)[5:-5, 5:-5].mean() > 0.3


@pytest.mark.parametrize("turn", [0.0, 0.03, -0.03])
@pytest.mark.parametrize("distance", [0.0, 1.0])
def test_median_turn_of_cast_rays(turn, distance):
    """A camera that turns by a sees what is x tangents aside move by a (1 + x^2), in the median over |x| < 0.215."""
    camera = CAMERAS[0]
    previous, current = pair(*intrinsics(camera), distance=distance, turn=turn, nod=0.01)
    left, up = median_turn(dense_flow(previous, current, camera))
    assert left == pytest.approx(turn * (1 + 0.1075**2), abs=3e-4)  # 0.04 pixels
    assert up == pytest.approx(0.01, abs=3e-4)
