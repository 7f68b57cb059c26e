"""Oracle: rays cast on a textured plane 1.65 m under the camera, for known distances, pitches and turns."""

import cv2
import numpy as np
import pytest

from tests.applications.car.vision.plane_for_tests import pair
from tests.applications.car.vision.test_camera import CAMERAS
from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.applications.car.vision.flow import median_turn
from torch_denkf.applications.car.vision.motion import image_motion
from torch_denkf.applications.car.vision.road import road_correlation
from torch_denkf.applications.car.vision.shapes import ROAD_PITCHES, ROAD_SHIFTS

cv2.setNumThreads(1)
CELL = 0.05  # m
SMALL, LARGE = CanonicalCamera(120.0), CanonicalCamera(240.0)


def views(camera, **motion):
    middle = (camera.width - 1) / 2, (camera.height - 1) / 2
    return pair((camera.height, camera.width), (camera.focal, camera.focal, *middle), **motion)


def row_of(pitch):
    row = int(np.abs(ROAD_PITCHES - pitch).argmin())
    assert ROAD_PITCHES[row] == pytest.approx(pitch)
    return row


def peak(correlations):
    """Returns the maximum of the parabola through the largest value and its neighbours, in m."""
    k = int(correlations.argmax())
    before, top, after = (float(value) for value in correlations[k - 1 : k + 2])
    return ROAD_SHIFTS[k] + CELL * 0.5 * (before - after) / (before - 2 * top + after)


@pytest.mark.parametrize(("pitch", "turn"), [(-0.04, 0.0), (-0.02, 0.03), (0.0, -0.03), (0.01, 0.0)])
def test_table_determines_the_pitch(pitch, turn):
    """A wrong pitch stretches near and far differently, so that they do not agree on a distance."""
    row = row_of(pitch)
    for distance in (1.0, 2.0):
        table = road_correlation(*views(LARGE, distance=distance, turn=turn, up=pitch), LARGE, (turn, 0.0))
        best = np.unravel_index(table.argmax(), table.shape)
        assert abs(best[0] - row) <= 1  # 0.005 rad is a pixel of this camera
        assert peak(table[row]) == pytest.approx(distance, abs=CELL / 5)
        assert table[row].max() > 0.95
    # A pitch that is wrong by 0.02 rad, the other way, misplaces the ground by 1 - (1.65 / 7) / (1.65 / 7 + 0.02), and
    # with it the distance, by about 8 %.
    wrong = row + (4 if pitch <= 0 else -4)
    assert abs(peak(table[wrong]) - 2.0) > 0.1
    assert table[wrong].max() < table[row].max() - 0.01


@pytest.mark.parametrize("turn", [0.0, -0.03])
@pytest.mark.parametrize("nod", [0.006, -0.006])
def test_a_nod_between_the_images_is_taken_out(turn, nod):
    previous, current = views(SMALL, distance=1.0, turn=turn, up=0.005, nod=nod)
    row = row_of(0.005)
    assert peak(road_correlation(previous, current, SMALL, (turn, nod))[row]) == pytest.approx(1.0, abs=CELL / 2)
    # A point z m ahead seems nearer or farther by z^2 / height * nod: 0.18 m at 7 m.
    for other, shift in ((0.0, nod), (-nod, 2 * nod)):
        table = road_correlation(previous, current, SMALL, (turn, other))
        assert (peak(table[row]) - 1.0) / shift == pytest.approx(7**2 / 1.65, rel=0.3)


def test_distance_grows_with_the_cameras_height():
    """One camera cannot tell a large world from a small one: all lengths are in proportion to the height."""
    images = views(SMALL, distance=1.0)
    for height in (1.5, 1.65, 1.85):
        table = road_correlation(*images, SMALL, (0.0, 0.0), height)
        assert peak(table[row_of(0.0)]) == pytest.approx(height / 1.65, abs=CELL / 2)


@pytest.mark.parametrize("name", ["odometry 125 x 414", "0926 125 x 414", "odometry 50 x 150"])
@pytest.mark.parametrize("turn", [0.0, 0.03, -0.03])
def test_image_motion_of_real_cameras(name, turn):
    """From the real camera's pixels to metres and angles, with the turn that the flow finds."""
    size, calibration = CAMERAS[name]
    camera, row = CanonicalCamera.near(calibration), row_of(-0.01)
    # The median over 3 x 3 pixels takes most of this fine texture away from a small image. What is left is as fine as
    # the noise of sampling it: errors up to 0.09 m of either sign over four textures, 0.02 m without the median.
    cells = 0.5 if size[0] > 100 else 2.5
    for distance in (0.5, 1.0, 2.0):
        images = pair(size, calibration, distance=distance, turn=turn, up=-0.01)
        flow, road = image_motion(*images, calibration)
        assert peak(road[row]) == pytest.approx(distance, abs=cells * CELL)
        seen = [camera.view(image, calibration) for image in images]
        assert peak(road_correlation(*seen, camera, (turn, 0.0))[row]) == pytest.approx(distance, abs=CELL / 2)
        left, up = median_turn(flow.transpose(1, 2, 0))
        assert left == pytest.approx(turn * (1 + 0.1075**2), abs=5e-4)
        assert up == pytest.approx(0.0, abs=5e-4)
