"""Weights, likelihood and memory of corners, in closed form.

Where the camera does not move, the disparity of the earlier row goes as it is into what the later row should show. Then
the covariance of what is left is diag(pixel^2, pixel^2, 2 disparity^2), and nothing is seen of the error that stays.
"""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t
from tensordict import TensorDict
from torch.testing import assert_close

from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motion, corner_motions
from torch_denkf.functional.manifolds import SE3

CAMERA = StereoCamera(700.0, (600.0, 180.0), 0.54)
NOISE = CornerNoise(0.2, 0.0, 0.1, 0.0, 0.5, 0.0, stereo_walk=0.3, freedom=3.0)


@pytest.fixture(autouse=True)
def _double(float64):
    return


def corners(count=12):
    torch.manual_seed(0)
    return torch.stack([600 + 200 * torch.randn(count), 180 + 50 * torch.randn(count), 10 + 30 * torch.rand(count)], -1)


def still(*shape):
    return SE3().neutral(torch.zeros(())).expand(*shape, 7)


def test_weights_and_likelihood_are_students():
    before = corners()
    left = torch.randn(12, 3) * torch.tensor([0.4, 0.4, 0.3])
    seen = torch.arange(12) > 1
    found = corner_motion(before, before + left, seen, CAMERA, NOISE, start=still(), steps=0)
    cov = torch.diag(torch.tensor([0.2**2, 0.2**2, 2 * 0.1**2]))
    nis = torch.einsum("ni,ij,nj->n", left, torch.linalg.inv(cov), left)
    assert_close(found.weight, torch.where(seen, (3 + 3) / (3 + nis), 0.0))
    density = multivariate_t(np.zeros(3), cov.numpy(), df=3).logpdf(left.numpy())
    assert found.log_likelihood.item() == pytest.approx(density[2:].mean(), rel=1e-9)
    assert_close(found.stereo, torch.zeros(12))
    assert_close(found.stereo_var, torch.full((12,), 0.5**2))


def test_disparity_is_clamped_at_half_a_pixel():
    """A corner in the middle of the picture, whose disparity must be less: what is left of it is that of half a pixel.

    The camera goes 5 m ahead, of 10 m where the disparity is a half: it doubles, and by t = 4 what goes through.
    """
    camera = StereoCamera(10.0, (50.0, 50.0), 0.5)
    noise = CornerNoise(0.02, 0.0, 0.05, 0.0, 1.0, 0.0, freedom=5.0)
    torch.manual_seed(0)
    points = torch.randn(3000, 3) * torch.tensor([2.0, 2.0, 0.5]) + torch.tensor([0.0, 0.0, 8.0])
    motion = SE3().exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 5.0]))
    before, after = camera.project(points), camera.project(points - motion[4:])
    before = torch.cat([before, torch.tensor([[50.0, 50.0, 0.8]])])
    after = torch.cat([after, torch.tensor([[50.0, 50.0, 0.6]])])
    seen = torch.ones(3001, dtype=torch.bool)
    found = corner_motion(before, after, seen, camera, noise, start=motion, steps=12)
    assert SE3().distance(found.motion, motion) < 1e-3
    t, wrong = (10 / 5) ** 2, 0.5 - 0.8
    left = 0.6 - 1.0 + t * wrong
    nis = left**2 / (0.05**2 * (1 + t**2) + (t - 1) ** 2)
    assert found.weight[-1].item() == pytest.approx((5 + 3) / (5 + nis), rel=1e-3)


@pytest.mark.parametrize("hidden", [1e6, float("nan")])
def test_corners_that_are_not_seen_do_not_matter(hidden):
    """Neither their numbers nor the gradients by those."""
    before = corners()
    after = before + 0.1 * torch.randn(12, 3)
    seen = torch.arange(12) % 3 > 0
    expected = corner_motion(before[seen], after[seen], seen[seen], CAMERA, NOISE)
    places = torch.where(seen[:, None], before, hidden).requires_grad_(True)
    later = torch.where(seen[:, None], after, hidden).requires_grad_(True)
    found = corner_motion(places, later, seen, CAMERA, NOISE)
    assert_close(found.motion, expected.motion, rtol=0, atol=1e-10)
    assert_close(found.cov, expected.cov, rtol=1e-7, atol=0)
    assert_close(found.log_likelihood, expected.log_likelihood)
    assert_close(found.weight[seen], expected.weight)
    assert not found.weight[~seen].any()
    (found.motion.sum() + found.log_likelihood).backward()
    for entry in (places, later):
        assert entry.grad.isfinite().all()
        assert not entry.grad[~seen].any()
    if hidden != hidden:  # a corner of which one number is NaN counts as not seen
        broken = torch.where(seen[:, None] | (torch.arange(3) != 1), after, hidden)
        found = corner_motion(before, broken, torch.ones(12, dtype=torch.bool), CAMERA, NOISE)
        assert_close(found.motion, expected.motion, rtol=0, atol=1e-10)
        assert not found.weight[~seen].any()


def rows(came_from, seen):
    """Corners ``[T, N]`` of a camera that stands, each in both rows of each pair."""
    count, most = seen.shape
    pixels = torch.cat([corners(most)[:, :2], corners(most)[:, :1] - corners(most)[:, 2:], corners(most)[:, 1:2]], -1)
    out = {"corners": pixels[:, None].expand(count, most, 2, 4).clone(), "seen": seen, "came_from": came_from}
    return TensorDict({**out, "repeats": torch.zeros(count, most, dtype=torch.int64)}, [count])


def test_corner_memory():
    """Gives corners without an error the weight w = (freedom + 3) / freedom, and the variance goes by it.

    From row to row it is divided by w, and a walk is added. A corner that is new, or was not seen in the row before,
    starts from its own variance. So does one whose weight was small.
    """
    count, most = 4, 8
    came_from = torch.arange(most).expand(count, most).clone()
    came_from[0], came_from[2, 1] = -1, -1  # corner 1 is another one from row 2 on
    seen = torch.ones(count, most, dtype=torch.bool)
    seen[0], seen[1, 2] = False, False  # corner 2 was not seen in row 1
    data = rows(came_from, seen)
    data["corners"][1, 3, 1, 1] += 30.0  # corner 3 is wrong in row 1, corner 4 a little
    data["corners"][1, 4, 1, 1] += 2.0
    found = corner_motions(data, CAMERA, NOISE, start=still(count), steps=0)
    w, first, walk = (3 + 3) / 3, 0.5**2, 0.3**2
    one = first / w
    two = (min(one, first) + walk) / w
    three = (min(two, first) + walk) / w
    expected = torch.tensor([one, two, three]).unsqueeze(-1).expand(3, most).clone()
    expected[1:, 1] = torch.tensor([first / w, (first / w + walk) / w])
    expected[:, 2] = torch.tensor([first, first / w, (first / w + walk) / w])
    expected[:, 3] = torch.tensor([first, (first + walk) / w, ((first + walk) / w + walk) / w])
    less = 6 / (3 + (2.0 / 0.2) ** 2)
    expected[:, 4] = torch.tensor([first / less, (first + walk) / w, ((first + walk) / w + walk) / w])
    assert 0 < found.weight[1, 3] < 0.03 < less
    assert_close(found.stereo_var[1:], expected)
    assert_close(found.stereo_var[0], torch.full((most,), first))


def test_a_disparity_error_that_stays_is_known_better_in_each_row():
    """The camera goes 2 m ahead from row to row; the right image of each corner is off by 0.4 pixels."""
    torch.manual_seed(0)
    count, most = 5, 12
    points, ahead = torch.randn(most, 3) + torch.tensor([0.0, 0.0, 25.0]), torch.tensor([0.0, 0.0, 2.0])
    seen = [CAMERA.project(points - row * ahead) for row in range(count)]
    pixels = [torch.stack([u, v, u - disparity - 0.4, v], -1) for u, v, disparity in (one.unbind(-1) for one in seen)]
    data = rows(torch.arange(most).expand(count, most).clone(), torch.ones(count, most, dtype=torch.bool))
    data["corners"] = torch.stack([torch.stack([pixels[max(row - 1, 0)], pixels[row]], 1) for row in range(count)])
    step = SE3().exp(torch.cat([torch.zeros(3), ahead])).expand(count, 7)
    left = (corner_motions(data, CAMERA, NOISE, start=step, steps=0).stereo[1:] - 0.4).abs().mean(-1)
    assert (left.diff() < 0).all()
    assert left[-1] < 0.8 * left[0]
