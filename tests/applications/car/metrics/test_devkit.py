"""Oracles: the development kit's loops written out over evo's relative poses, evo's own pairs, numbers by hand."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from evo.core.metrics import RPE

from tests.applications.car.metrics.paths_for_tests import matrices, straight, winding
from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error
from torch_denkf.functional.manifolds import SE3, SO3

LENGTHS = (100, 200, 300, 400, 500, 600, 700, 800)


def written_out(estimated, truth, lengths=LENGTHS, step=10):
    """Segments by search, errors by evo's matrices: (length, %, deg/m) for each."""
    poses, poses_true = matrices(estimated), matrices(truth)
    travelled = [0.0]
    for before, after in pairwise(poses_true):
        travelled.append(travelled[-1] + np.linalg.norm(after[:3, 3] - before[:3, 3]))
    out = []
    for first in range(0, len(travelled), step):
        for length in lengths:
            last = next((k for k in range(first, len(travelled)) if travelled[k] > travelled[first] + length), None)
            if last is not None:
                error = RPE.rpe_base(poses_true[first], poses_true[last], poses[first], poses[last])
                angle = math.acos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
                out.append((length, 100 * np.linalg.norm(error[:3, 3]) / length, math.degrees(angle) / length))
    return torch.tensor(out, dtype=torch.float64)


def test_the_definition_written_out():
    truth, estimated = winding(0, rows=460), winding(1, rows=460)
    error = kitti_devkit_error(estimated, truth)
    expected = written_out(estimated, truth)
    assert len(set(expected[:, 0].tolist())) == 4  # of 459 m or so
    torch.testing.assert_close(error.translation, expected[:, 1].mean())
    torch.testing.assert_close(error.rotation, expected[:, 2].mean(), atol=1e-7, rtol=1e-7)
    for k, length in enumerate(LENGTHS):
        rows = expected[expected[:, 0] == length]
        assert error.segments[k] == len(rows)
        torch.testing.assert_close(error.length_translation[k], rows[:, 1].mean(), equal_nan=True)
        torch.testing.assert_close(error.length_rotation[k], rows[:, 2].mean(), equal_nan=True, atol=1e-7, rtol=1e-7)


def test_invalid_input_raises():
    path = straight(90)
    with pytest.raises(ValueError, match=r"the shortest path is 89\.0 m long; leave such paths out"):
        kitti_devkit_error(path, path)
    assert kitti_devkit_error(path, path, lengths=(88.5,)).segments.tolist() == [1]
    for options in ({"step": 0}, {"lengths": ()}, {"lengths": (0, 100)}):
        with pytest.raises(ValueError, match="must be positive"):
            kitti_devkit_error(path, path, **options)
    with pytest.raises(ValueError, match=r"pass state\[..., :3\]"):
        kitti_devkit_error(path[:, :2], path[:, :2])


def in_space(path):
    """Returns a planar path (x, y, angle) as points of SE3, whose z is up."""
    turn = SO3().exp(torch.cat([torch.zeros_like(path[..., :2]), path[..., 2:]], -1))
    return torch.cat([turn, path[..., :2], torch.zeros_like(path[..., :1])], -1)


def random_path(steps=400):
    torch.manual_seed(0)
    angle = (0.02 * torch.randn(2, steps, dtype=torch.float64)).cumsum(-1)
    step = torch.stack([angle.cos(), angle.sin()], -1)
    return torch.cat([step.cumsum(-2), angle.unsqueeze(-1)], -1)


def test_a_planar_path_has_the_planar_error():
    truth = random_path()
    estimated = truth + 0.05 * torch.randn_like(truth).cumsum(-2)
    planar, spatial = kitti_devkit_error(estimated, truth), kitti_devkit_error(in_space(estimated), in_space(truth))
    for name in planar._fields:
        torch.testing.assert_close(getattr(spatial, name), getattr(planar, name), equal_nan=True)


def test_the_frames_of_both_paths_do_not_count():
    truth = in_space(random_path())
    estimated = SE3().plus(truth, 0.01 * torch.randn(2, 400, 6, dtype=torch.float64))
    moved = SE3().exp(torch.randn(6, dtype=torch.float64))
    other = SE3().compose(moved.expand_as(estimated), estimated)
    torch.testing.assert_close(
        kitti_devkit_error(other, truth).translation, kitti_devkit_error(estimated, truth).translation
    )


def test_a_climb_that_is_not_seen():
    """One metre up in a hundred metres ahead: the distance left is 1 m in 100 m, the angle is the slope's."""
    truth = torch.zeros(301, 7, dtype=torch.float64)
    truth[:, 0], truth[:, 4] = 1.0, torch.arange(301)
    slope = torch.tensor(0.01, dtype=torch.float64)
    estimated = truth.clone()
    estimated[:, 4], estimated[:, 6] = slope.cos() * truth[:, 4], slope.sin() * truth[:, 4]
    error = kitti_devkit_error(estimated, truth, lengths=(100,))
    # A segment of 100 m ends with the first row beyond: 101 m.
    torch.testing.assert_close(error.translation, 101 * 2 * (slope / 2).sin() * 100 / 100)
    assert error.rotation == 0
