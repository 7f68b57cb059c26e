"""A camera is found again from drawn frames of which it is known."""

import numpy as np
import pytest

from tests.envs.opengl import needs_opengl

pytest.importorskip("cv2")
needs_opengl()

from benchmarks.ur5 import laboratory  # noqa: E402
from benchmarks.ur5.laboratory import Drawn, find_camera, look_of  # noqa: E402

TRUE = np.array([1.36, 0.06, 0.88, -0.17, 0.01, 0.26, 0.02, 34.0, 0.0])
GAIN, OFFSET = np.array([0.6, 0.5, 0.4]), np.array([30.0, 25.0, 20.0])
SIDE = 112


@pytest.fixture(scope="module")
def seen():
    """Yields frames of random poses before a wall of stripes, as the camera TRUE sees them; and the joints."""
    rng, drawn = np.random.default_rng(0), Drawn(SIDE, look_of(TRUE))
    joints = laboratory.HOME + rng.uniform(-0.6, 0.6, (30, 7)) * [1, 0.6, 0.6, 1, 1, 3, 0.4]
    stripes = 90.0 + 30.0 * np.sin(np.arange(SIDE) / 5)[None, :, None] + np.zeros((SIDE, SIDE, 3))
    pictures, covered = map(np.stack, zip(*(drawn.arm(row) for row in joints), strict=True))
    frames = np.where(covered[..., None] == 1, GAIN * pictures + OFFSET, stripes)
    yield frames.round().astype(np.uint8), joints, stripes
    drawn.close()


@pytest.mark.slow
def test_the_camera_is_found(seen):
    frames, joints, _ = seen
    found, share = find_camera(frames, joints, ((20, 4.0, 5), (30, 1.5, 5)))
    assert share < 0.2
    drawn = Drawn(SIDE)

    def silhouettes(look):
        drawn.look(look)
        return np.stack([drawn.arm(row)[1] for row in joints[:10]])

    true, near, before = (silhouettes(look) for look in (look_of(TRUE), found, laboratory.SIM))
    drawn.close()
    assert np.abs(near - true).sum() < 0.25 * np.abs(before - true).sum()
