"""Oracles: evo's relative pose error, and numbers by hand."""

import math

import pytest
import torch

from tests.applications.car.metrics.paths_for_tests import evo_errors, straight, winding
from torch_denkf.applications.car.metrics.benchmark import kitti_pathlength_error
from torch_denkf.applications.car.metrics.odometry import kitti_endpoint_error


@pytest.mark.parametrize(("window", "stride"), [(1, 1), (37, 1), (30, 7)])
def test_endpoint_error_is_that_of_evo(window, stride):
    truth, estimated = winding(0, rows=200), winding(1, rows=200)
    error = kitti_endpoint_error(estimated, truth, window=window, stride=stride, min_length=0.0)
    last, metres, degrees = evo_errors(estimated, truth, window)
    assert last.equal(torch.arange(window, 200))
    step = (truth[1:, :2] - truth[:-1, :2]).norm(dim=-1)
    length = torch.stack([step[i : i + window].sum() for i in range(200 - window)])
    torch.testing.assert_close(error.window_translation, (metres / length)[::stride])
    torch.testing.assert_close(error.window_rotation, (degrees / length)[::stride], atol=1e-7, rtol=1e-7)
    assert metres.mean() > 0.1


def test_a_window_of_all_steps_fits_and_one_more_does_not():
    path, metric = straight(101), kitti_pathlength_error
    assert metric(path, path).windows == (100,)
    with pytest.raises(ValueError, match="fits into 100 poses"):
        metric(path[:-1], path[:-1])
    with pytest.raises(ValueError, match="at least 1 each, got"):
        metric(path, path, windows=[0])
    with pytest.raises(ValueError, match="at least 1 each, got"):
        metric(path, path, windows=[])
    with pytest.raises(ValueError, match=r"pass state\[..., :3\]"):
        metric(torch.zeros(200, 5), torch.zeros(200, 5))


def test_pathlength_error_ignores_cancelling_errors():
    truth = straight(101)
    backwards = truth * torch.tensor([-1.0, 1.0, 1.0])
    turned = kitti_pathlength_error(backwards, truth)
    assert (turned.translation, turned.rotation) == (0, 0)
    torch.testing.assert_close(kitti_endpoint_error(backwards, truth).translation.item(), 2.0)
    # A whole turn too many is an error of 360 degrees there, and none here.
    spun = truth + torch.tensor([0.0, 0.0, 2 * math.pi])
    torch.testing.assert_close(kitti_pathlength_error(spun, truth).rotation.item(), 3.6)
    assert kitti_endpoint_error(spun, truth).rotation < 1e-9


def test_pathlength_error_sums_the_steps_of_each_path():
    truth, estimated = winding(0, rows=150, batch=(2, 2)), winding(1, rows=150, batch=(2, 2))
    errors = kitti_pathlength_error(estimated, truth, windows=[10, 149])
    for i in range(2):
        for k, window in enumerate((10, 149)):
            length, length_true = (
                sum(math.dist(path[t, :2].tolist(), path[t + 1, :2].tolist()) for t in range(window))
                for path in (estimated[1, i], truth[1, i])
            )
            expected = abs(length - length_true) / length_true
            torch.testing.assert_close(errors.window_translation[1, i, k].item(), expected)
    standing = torch.cat([straight(1).expand(50, 3), straight(60)])
    with pytest.raises(ValueError, match="stands still"):
        kitti_pathlength_error(standing, standing, windows=[20, 100])
