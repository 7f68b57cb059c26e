"""KITTI's metric of paths in space."""

import torch

from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error
from torch_denkf.functional.manifolds import SE3, SO3


def in_space(path):
    """A planar path (x, y, angle) as points of SE3, whose z is up."""
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
