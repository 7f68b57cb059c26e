"""Oracles: the loss of an ensemble drawn from the belief, densities by torch.distributions, sums written out."""

import math

import pytest
import torch

from tests.filters.factories import linear_kalman
from tests.filters.gaussian_for_tests import linear_frames
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
