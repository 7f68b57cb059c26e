"""Compares the filters that the study learns from readings with the exact filter and closed forms."""

import math

import pytest
import torch

from benchmarks.control import hike
from benchmarks.control.learning import LEAST, Learner, Learning, between
from benchmarks.control.tasks import TASKS
from torch_denkf.objectives import DEnKFLoss, GaussianLoss


@pytest.mark.slow
def test_a_filter_that_learns_from_readings_alone_comes_near_the_kalman_filter():
    """On the hike: the innovations' likelihood within 0.04 nats a reading of the exact one's, from over 0.1."""
    torch.manual_seed(0)
    learned, exact = hike.unlearned_filter(32), hike.exact_filter(0.2)
    learner = Learner(learned, TASKS["hike"].prior, 64, Learning())
    learner.add(hike.MountainHike(64, 0.2, seed=0).rollout(hike.STEPS))
    test = hike.MountainHike(200, 0.2, seed=1).rollout(hike.STEPS).exclude("next")

    def score(filter, Loss):
        zeros = {"state": 0.0, "transition": 0.0, "sensor": 0.0, "nll": 1.0}
        with torch.no_grad():
            return Loss(filter, **zeros)(test)["loss_nll"].item()

    best, before = score(exact, GaussianLoss), score(learned, DEnKFLoss)
    learner.update(300)
    after = score(learned, DEnKFLoss)
    assert best < after < best + 0.04
    assert before > best + 0.1
    strides = learned["transition"].module["transition"].module.weight[:, 2:]
    torch.testing.assert_close(strides, hike.STRIDE * torch.eye(2), atol=0.02, rtol=0)


def test_neighbouring_readings_put_their_noise():
    """Readings 0, 2, -2, 0 of one component, and 1, missing, 5, 6 of another: (4 + 16 + 4) / 3 / 2, and 1 / 2."""
    nan = float("nan")
    readings = torch.tensor([[[0.0, 1.0], [2.0, nan], [-2.0, 5.0], [0.0, 6.0]]])
    torch.testing.assert_close(between(readings), torch.tensor([4.0, 0.5]))
    torch.testing.assert_close(between(torch.zeros(1, 3, 2)), torch.full((2,), LEAST**2))


def test_the_first_episodes_alone_put_the_readings_noise():
    """A component of which no two neighbours came keeps the filter's own, 0.2^2; the process noise stays."""
    filter, learning = hike.unlearned_filter(4), Learning(window=None, windows=2, guess=True)
    learner = Learner(filter, TASKS["hike"].prior, 4, learning)
    data = hike.MountainHike(2, 0.2).rollout(4)
    data["observation"][..., 0] = torch.tensor([0.0, 2.0, -2.0, 0.0])
    data["observation"][..., 1] = torch.tensor([7.0, math.nan, math.nan, 3.0])
    learner.add(data)
    own = filter["noise"].log_variance
    (process,) = [noise for noise in learner.noises if noise is not own]
    torch.testing.assert_close(own.exp(), torch.tensor([4.0, 0.04]))
    torch.testing.assert_close(process.exp(), torch.full((2,), 0.01))
    learner.add(hike.MountainHike(2, 0.2).rollout(4))
    torch.testing.assert_close(own.exp(), torch.tensor([4.0, 0.04]))
