"""The motion of a camera from tracked corners, against motions that are known."""

import cv2
import numpy as np
import pytest

from tests.applications.car.vision.plane_for_tests import pair
from torch_denkf.applications.car.vision.epipolar import fit_two_view, track_corners, two_view_motion

CALIBRATION = (240.0, 240.0, 207.0, 62.0)


def rotation(left, up, around):
    """From the axes of the older camera to those of the newer one; axes point right, down, forward."""
    cos, sin = np.cos, np.sin
    about_y = np.array([[cos(left), 0, sin(left)], [0, 1, 0], [-sin(left), 0, cos(left)]])
    about_x = np.array([[1, 0, 0], [0, cos(up), sin(up)], [0, -sin(up), cos(up)]])
    about_z = np.array([[cos(around), -sin(around), 0], [sin(around), cos(around), 0], [0, 0, 1]])
    return about_y @ about_x @ about_z  # the heading is then that of the planar state


def views(turn, focus, seed=0, count=200, way=0.8):
    """Points 4 to 40 m off that a camera sees before and after it has turned and driven ``way`` metres."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(4, 40, count)
    points = np.stack([rng.uniform(-0.8, 0.8, count) * depth, rng.uniform(-0.25, 0.25, count) * depth, depth], 1)
    moved = points @ rotation(*turn).T - way * np.array([*focus, 1.0])
    return points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.09, 0.0, 0.0), (-0.05, 0.01, -0.02)])
@pytest.mark.parametrize("focus", [(0.0, 0.0), (0.04, -0.02)])
def test_exact_points_give_the_motion(turn, focus):
    found = fit_two_view(*views(turn, focus))
    np.testing.assert_allclose(found.turn, turn, atol=1e-4)
    np.testing.assert_allclose(found.focus, focus, atol=1e-3)
    assert found.inliers == 1.0


def test_a_third_of_wrong_points_changes_nothing():
    first, second = views((0.03, 0.0, 0.0), (0.0, -0.01), count=300)
    second[::3] += np.random.default_rng(1).uniform(-0.2, 0.2, (100, 2))
    found = fit_two_view(first, second)
    assert found.turn[0] == pytest.approx(0.03, abs=2e-4)
    assert 0.6 < found.inliers < 0.75


def test_standard_deviations_are_those_of_many_draws():
    rng = np.random.default_rng(2)
    first, second = views((0.02, 0.0, 0.0), (0.0, -0.01), count=150)
    noisy = [fit_two_view(first, second + rng.normal(0, 1e-3, second.shape)) for _ in range(60)]
    for found, told in (
        (np.std([m.turn[0] for m in noisy]), np.mean([m.turn_std[0] for m in noisy])),
        (np.std([m.focus[1] for m in noisy]), np.mean([m.focus_std[1] for m in noisy])),
    ):
        assert told == pytest.approx(found, rel=0.35)


def texture(rows=125, columns=414):
    image = np.random.default_rng(0).integers(0, 255, (rows, columns + 20)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(image, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)


def turned(image, left):
    """Draws what a camera sees of the same things far away after it has turned to the left."""
    fx, fy, cx, cy = CALIBRATION
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return cv2.warpPerspective(image, matrix @ rotation(left, 0, 0) @ np.linalg.inv(matrix), (414, 125))


def test_corners_move_with_the_image():
    image = texture()
    before, after = track_corners(image[:, :414], image[:, 3:417])
    assert len(before) > 200
    np.testing.assert_allclose(np.median(after - before, 0), [-3.0, 0.0], atol=0.02)


@pytest.mark.parametrize("disturb", ["clean", "specks", "darker"])
def test_images_of_a_turn_give_the_turn(disturb):
    image = texture()[:, :414]
    other = turned(image, 0.04)
    if disturb == "specks":
        rng = np.random.default_rng(3)
        for picture in (image, other):
            picture[rng.random(picture.shape) < 0.02] = 255
            picture[rng.random(picture.shape) < 0.02] = 0
    elif disturb == "darker":
        other = cv2.convertScaleAbs(other, alpha=0.6, beta=10)
    motion = two_view_motion(image, other, CALIBRATION)
    assert motion[0] == pytest.approx(0.04, abs=4e-4)
    assert motion[-1] > 0.5


def test_what_hides_the_scene_gives_no_corners():
    """A box that stands still fills most of a turning view: its corners do not turn."""
    image = texture()[:, :414]
    other = turned(image, 0.04)
    hidden = np.zeros(image.shape, bool)
    hidden[10:115, 60:330] = True
    for picture in (image, other):
        picture[hidden] = texture()[::-1, :414][hidden]
    told = two_view_motion(image, other, CALIBRATION, hidden=hidden)
    assert told[0] == pytest.approx(0.04, abs=4e-4)
    assert abs(two_view_motion(image, other, CALIBRATION)[0] - 0.04) > 0.02
    before, _ = track_corners(image, other, hidden)
    assert len(before) > 20
    assert not hidden[before[:, 1].round().astype(int), before[:, 0].round().astype(int)].any()


@pytest.mark.parametrize("doubled", [1, 2])
def test_a_small_image_is_as_good_as_itself_enlarged(doubled):
    """Reads off an enlarged ramp where the optical axis is in the enlarged image: pixels are not where they were."""
    height, width, focal, center = 30, 104, 110.0 / doubled, (50.3, 14.2)
    small = large = pair((height, width), (focal, focal, *center), distance=1.0, turn=0.02)
    ramps = [np.tile(np.arange(size, dtype=np.float32), (2, 1)) for size in (width, height)]
    for _ in range(doubled):
        large = [cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC) for image in large]
        ramps = [cv2.resize(ramp, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR) for ramp in ramps]
    moved = [np.interp(at, ramp[0], np.arange(ramp.shape[1])) for at, ramp in zip(center, ramps, strict=True)]
    told = two_view_motion(*large, (2**doubled * focal, 2**doubled * focal, *moved))
    np.testing.assert_allclose(two_view_motion(*small, (focal, focal, *center)), told, atol=1e-5)
    assert told[0] == pytest.approx(0.02, abs=1e-3)
