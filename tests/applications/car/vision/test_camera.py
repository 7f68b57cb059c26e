"""Oracle: a spot painted where the pinhole projection of a direction falls, found again by its centre of mass."""

import cv2
import numpy as np
import pytest

from torch_denkf.applications.car.vision.camera import CanonicalCamera

cv2.setNumThreads(1)


def scaled(native, intrinsics, size):
    """(fx, fy, cx, cy) after a resize: pixels are areas, whose corner at (-0.5, -0.5) stays."""
    down, across = size[0] / native[0], size[1] / native[1]
    fx, fy, cx, cy = intrinsics
    return fx * across, fy * down, (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5


ODOMETRY, RAW_0926 = (718.856, 718.856, 607.1928, 185.2157), (721.5377, 721.5377, 609.5593, 172.854)
CAMERAS = {
    "odometry 125 x 414": ((125, 414), scaled((376, 1241), ODOMETRY, (125, 414))),
    "odometry 50 x 150": ((50, 150), scaled((376, 1241), ODOMETRY, (50, 150))),
    "0926 125 x 414": ((125, 414), scaled((375, 1242), RAW_0926, (125, 414))),
    "0926 full": ((375, 1242), RAW_0926),
}
DIRECTIONS = [(0.0, 0.0), (0.4, 0.1), (-0.5, -0.12), (0.7, 0.17), (-0.75, 0.2)]


def spot(size, column, row, width):
    """Returns a Gaussian bump of ``width`` pixels, uint8."""
    v, u = np.mgrid[: size[0], : size[1]]
    return np.round(250 * np.exp(-((u - column) ** 2 + (v - row) ** 2) / (2 * width**2))).astype(np.uint8)


def centre(image):
    weight = image.astype(float) / image.sum(dtype=float)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    return (weight * columns).sum(), (weight * rows).sum()


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_direction_is_seen_where_the_canonical_camera_projects_it(name, direction):
    size, (fx, fy, cx, cy) = CAMERAS[name]
    camera = CanonicalCamera.near((fx, fy, cx, cy))
    image = spot(size, cx + fx * direction[0], cy + fy * direction[1], width=3 * fx / 240)
    seen = camera.view(image, (fx, fy, cx, cy))
    assert seen.shape == (camera.height, camera.width)
    # Warping interpolates between 1/32 of a pixel at best, grey levels are rounded, and a spot of the small camera is
    # one pixel wide: a tenth of a canonical pixel is more than all of these, 1/5 of what a wrong half pixel would do.
    expected = [
        (camera.width - 1) / 2 + camera.focal * direction[0],
        (camera.height - 1) / 2 + camera.focal * direction[1],
    ]
    np.testing.assert_allclose(centre(seen), expected, rtol=0, atol=0.1)
    np.testing.assert_allclose(camera.pixels(*map(np.float64, direction)), expected, rtol=0, atol=1e-4)


def test_a_large_image_is_averaged_and_not_sampled():
    rng = np.random.default_rng(0)
    large = rng.integers(0, 256, (376, 1241)).astype(np.uint8)  # white noise: its means over 3 x 3 pixels vary a third
    camera = CanonicalCamera(240.0)
    calibration = (720.0, 720.0, 620.0, 187.5)
    inside = camera.view(large, calibration)[10:-10, 20:-20].astype(float)
    assert 15 < inside.std() < 30  # 256 / sqrt(12) = 74 for single pixels, 25 for means of nine
