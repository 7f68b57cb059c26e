"""Altitudes that drift while a car stands become no walls; honest hills stay as they are."""

import numpy as np
import pytest

from torch_denkf.applications.car.kitti.altitude import TOLERANCE, steady_altitude
from torch_denkf.applications.car.kitti.render import random_drive
from torch_denkf.applications.car.street.random_drive import hilly_poses


@pytest.fixture
def hills():
    rng = np.random.default_rng(3)
    return hilly_poses(random_drive(400, rng), rng)


def test_hills_are_unchanged(hills):
    assert np.ptp(hills[:, 1, 3]) > 2  # m: there are some
    assert np.array_equal(steady_altitude(hills), hills)


def test_a_drift_at_rest_is_taken_out_and_nothing_else(hills):
    rest = np.repeat(hills[150:151], 40, axis=0)
    stopped = np.concatenate([hills[:150], rest, hills[150:]])
    drifting = stopped.copy()
    drifting[150:190, 1, 3] -= np.linspace(0, 3, 40)  # climbs by 3 m without moving
    drifting[190:, 1, 3] -= 3
    found = steady_altitude(drifting)
    np.testing.assert_allclose(found, stopped, atol=1e-9)


def test_a_slow_climb_keeps_to_where_the_camera_looks(hills):
    wall = hills.copy()
    wall[200:, 1, 3] -= 5  # within one step
    found = steady_altitude(wall)
    step = np.diff(found[:, :, 3], axis=0)[199]
    original = np.diff(hills[:, :, 3], axis=0)[199]
    assert step[1] >= original[1] - 2 * TOLERANCE * np.hypot(*original[[0, 2]])
    assert np.array_equal(found[:, :, :3], wall[:, :, :3])
    assert np.array_equal(found[:, [0, 2], 3], wall[:, [0, 2], 3])
