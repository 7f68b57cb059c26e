"""Oracles: numbers by hand, closed forms of circles, and the official trajectories."""

import numpy as np
import pytest
import torch

from tests.applications.car.metrics.paths_for_tests import straight
from tests.real_data import KITTI
from torch_denkf.applications.car import dead_reckoning
from torch_denkf.applications.car.metrics.odometry import kitti_endpoint_error

POSES = KITTI / "poses"


def test_speed_bias_of_a_tenth_is_a_tenth_of_a_metre_for_each_metre():
    truth = straight()
    estimated = truth * torch.tensor([1.1, 1.0, 1.0])
    for align in (True, False):
        error = kitti_endpoint_error(estimated, truth, align=align)
        assert error.windows == 101
        assert error.window_translation.shape == (101,)
        assert error.rotation == 0
        if align:
            torch.testing.assert_close(error.window_translation, torch.full((101,), 0.1).double())
        else:  # the i-th window ends at row 100 + i, whose error is a tenth of that
            expected = 0.1 * (100 + torch.arange(101, dtype=torch.float64)) / 100
            torch.testing.assert_close(error.window_translation, expected)


def test_standing_windows_are_left_out():
    truth = torch.cat([straight(11), straight(11)[-1:].expand(20, 3)])
    estimated = truth * torch.tensor([1.2, 1.0, 1.0])
    error = kitti_endpoint_error(estimated, truth, window=10)
    # Windows starting at rows 0 to 9 travel 10 to 1 m; those from row 10 on stand.
    assert error.windows == 10
    assert error.window_translation[10:].isnan().all()
    torch.testing.assert_close(error.translation.item(), 0.2)
    with pytest.raises(ValueError, match=r"no window of 10 steps in which the car travels 1\.0 m"):
        kitti_endpoint_error(estimated[11:], truth[11:], window=10)


def official(sequence):
    """(x, y, θ) as in Kloss et al., and the backward differences (v, θ_dot), by NumPy alone."""
    file = POSES / f"{sequence}.txt"
    if not file.is_file():
        pytest.skip(f"no KITTI poses at {file}")
    rows = np.loadtxt(file).reshape(-1, 3, 4)
    x, y = rows[:, 2, 3], -rows[:, 0, 3]
    theta = np.unwrap(-np.arctan2(-rows[:, 2, 0], rows[:, 2, 2]))
    dt = 0.103
    v = np.hypot(np.diff(x), np.diff(y)) / dt
    velocities = np.stack([np.r_[v[:1], v], np.r_[0.0, np.diff(theta)] / dt], -1)
    return torch.tensor(np.stack([x, y, theta], -1)), torch.tensor(velocities)


# Measured: 0.0075 and 0.0132 m/m with the heading half way, 0.0099 and 0.0152 with the old heading (Kloss's motion
# model). REPRODUCTION.md, section 7, has 0.0071 and 0.0098 from 1588 and 4068 of the 1591 and 4071 rows.
@pytest.mark.parametrize(("sequence", "bound"), [("09", 0.0080), ("08", 0.0138)])
def test_true_velocities_leave_only_the_sideways_motion_of_the_camera(sequence, bound):
    truth, velocities = official(sequence)
    dt = 0.103
    error = kitti_endpoint_error(dead_reckoning(velocities, truth[0], dt), truth)
    assert error.translation < bound
    assert error.rotation < 1e-9  # the turn rate is exact
    # Kloss's step moves along the old heading and is worse by the turn of half a step.
    shifted = torch.cat([truth[:1, 2], truth[:-1, 2]])
    step = torch.stack([shifted.cos(), shifted.sin()], -1) * velocities[:, :1] * dt
    step[0] = truth[0, :2]
    old = torch.cat([step.cumsum(0), truth[:, 2:]], -1)
    assert error.translation < 0.9 * kitti_endpoint_error(old, truth).translation
