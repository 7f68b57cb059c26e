"""The motion of a camera from tracked corners, against motions that are known."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torch_denkf.applications.car.vision.epipolar import fit_two_view, track_corners, two_view_motion

CALIBRATION = (240.0, 240.0, 207.0, 62.0)


def rotation(left, up, around):
    """From the axes (right, down, ahead) of the older camera to those of the newer one."""
    return Rotation.from_euler("YXZ", [left, -up, around]).as_matrix()  # the heading is then that of the planar state


def views(turn, focus, seed=0, count=200, way=0.8):
    """Returns points at 4 to 40 m in both images of a camera that rotates and drives ``way`` metres."""
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


def test_occlusion_gives_no_corners():
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
