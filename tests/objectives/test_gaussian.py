"""Oracles: the loss of an ensemble drawn from the belief, densities by torch.distributions, sums written out."""

import math

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_kalman
from tests.filters.gaussian_for_tests import learned_filter, learned_frames, linear_filter, linear_frames
from torch_denkf.applications.car.modules.pairs import ClonedPrior
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble
from torch_denkf.functional.manifolds import Flat
from torch_denkf.modules import GaussianAround, KalmanAnalysis
from torch_denkf.objectives import GaussianLoss

OFF = {"state": 0.0, "transition": 0.0, "sensor": 0.0}


def frames_with_state(batch=3, steps=8, **kwargs):
    frames = linear_frames(batch, steps, **kwargs)
    return frames.set("state", torch.randn(batch, steps, 2))


@pytest.mark.parametrize("score", ["crps", "nll", "mse"])
def test_dims_scales_and_infinite_scales_choose_the_same(float64, score):
    frames, filter = frames_with_state(), linear_kalman()
    make = lambda **kwargs: GaussianLoss(filter, **{**OFF, "state": 1.0}, score=score, **kwargs)(  # noqa: E731
        frames
    )["loss_state"]
    chosen = make(dims=[1], state_scale=[3.0])
    torch.testing.assert_close(make(state_scale=[math.inf, 3.0]), chosen, rtol=1e-12, atol=0)
    torch.testing.assert_close(make(dims=[0, 1], state_scale=[math.inf, 3.0]), chosen, rtol=1e-12, atol=0)
    torch.testing.assert_close(make(dims=[1, 0], state_scale=[3.0, math.inf]), chosen, rtol=1e-12, atol=0)
    assert (chosen - make()).abs() > 1e-3
    if score != "nll":  # the units of the mean squared error and of the CRPS
        torch.testing.assert_close(make(dims=[1]), chosen * (9 if score == "mse" else 3), rtol=1e-12, atol=0)


def test_a_truth_with_fewer_dimensions_than_the_belief(float64):
    # The truth of a vehicle has five dimensions, the belief nine: clones of past velocities come after them.
    class Keep(torch.nn.Module):
        in_keys, out_keys = [("belief", "mean"), ("belief", "cov")], [("forecast", "mean"), ("forecast", "cov")]

        def forward(self, td):
            return td.set(("forecast", "mean"), td["belief", "mean"]).set(("forecast", "cov"), td["belief", "cov"])

    H = torch.zeros(1, 9)
    H[0, 3] = 1
    analysis = KalmanAnalysis(H, torch.ones(1))
    filter = Filter(Keep(), analysis, initial=ClonedPrior(GaussianAround([1.0] * 5), 2))
    frames = TensorDict({"state": torch.randn(2, 4, 5), "observation": torch.randn(2, 4, 1)}, [2, 4])
    out = filter.sequence(frames.copy())
    assert out["belief", "mean"].shape == (2, 4, 9)
    error = (out["belief", "mean"][..., :5] - frames["state"])[:, 1:]
    loss = GaussianLoss(filter, **{**OFF, "state": 1.0}, score="mse")
    torch.testing.assert_close(loss(frames)["loss_state"], error.square().mean())
    loss = GaussianLoss(filter, **{**OFF, "state": 1.0}, score="mse", dims=(2, 4), space=Flat(9, circular=[2, 3]))
    error = error[..., [2, 4]]
    error[..., 0] = torch.remainder(error[..., 0] + math.pi, 2 * math.pi) - math.pi
    torch.testing.assert_close(loss(frames)["loss_state"], error.square().mean())
    frames["state"][:, 1:, 2] += 2 * math.pi  # the initial belief is around the first state
    torch.testing.assert_close(loss(frames)["loss_state"], error.square().mean())


def test_sensor_term(float64):
    filter, frames = learned_filter("EKF"), learned_frames(3, 6)
    target = torch.randn(3, 6, 2)
    frames["target_observation"] = target
    samples, seen = filter.sequence(frames.copy())["sensor", "ensemble"], frames["observed"].all(-1)
    scale = torch.tensor([2.0, 0.5])
    loss = GaussianLoss(filter, **{**OFF, "sensor": 1.0}, observation_scale=scale)
    expected = crps_ensemble(samples / scale, target / scale).mean(-1)[seen].mean()
    torch.testing.assert_close(loss(frames)["loss_sensor"], expected)
    loss = GaussianLoss(filter, **{**OFF, "sensor": 1.0}, score="mse")
    expected = (samples.mean(-2) - target).square().mean(-1)[seen].mean()
    torch.testing.assert_close(loss(frames)["loss_sensor"], expected)
    # One reading has no spread to score: its CRPS is the absolute error.
    plain = frames_with_state(missing=0.0)
    H = torch.tensor([[1.0, 0.5], [0.0, 1.0]])
    error = plain["observation"] - plain["state"] @ H.mT
    for score, expected in (("crps", error.abs().mean()), ("mse", error.square().mean())):
        loss = GaussianLoss(linear_filter("EKF"), **{**OFF, "sensor": 1.0}, score=score)
        loss.set_keys(sensor="observation")
        torch.testing.assert_close(loss(plain)["loss_sensor"], expected)


def test_a_belief_without_spread_has_a_finite_gradient(float64):
    filter = linear_kalman()
    filter.initial.cov.zero_()
    filter["transition"].noise.zero_()
    filter["transition"].matrix.requires_grad_()
    frames = frames_with_state(resets=False)
    loss = GaussianLoss(filter, **{**OFF, "state": 1.0})
    value = loss(frames)["loss_state"]
    error = (filter.sequence(frames.copy())["belief", "mean"] - frames["state"])[:, 1:].abs().mean()
    torch.testing.assert_close(value, error, rtol=0, atol=1e-6)
    (gradient,) = torch.autograd.grad(value, filter["transition"].matrix)
    assert gradient.isfinite().all()
