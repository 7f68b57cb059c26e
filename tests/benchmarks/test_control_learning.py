"""How the study's filters learn from readings, against the exact filter and closed forms."""

import math

import pytest
import torch

from benchmarks.control import hike, pendulum
from benchmarks.control.learning import LEAST, Learner, Learning, between, refiltered
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


def test_whole_episodes_teach_that_the_walker_stays_where_it_is_when_readings_say_little():
    """On one batch with noise of 0.8; windows under a wide prior teach that positions shrink by 15 % a step or more."""
    torch.manual_seed(0)
    learned, exact = hike.unlearned_filter(32), hike.exact_filter(0.8)
    learner = Learner(learned, TASKS["hike"].prior, 32, TASKS["hike"].learning)
    learner.add(hike.MountainHike(32, 0.8, seed=0).rollout(hike.STEPS))
    steps = 2 * (hike.STRIDE**2 / 3 + hike.PROCESS**2)  # of two neighbouring readings, with actions in [-1, 1]
    torch.testing.assert_close(
        learned["noise"].log_variance.exp(), torch.full((2,), 0.8**2 + steps / 4), atol=0.05, rtol=0
    )  # 4,700 differences: 0.05 is 3 standard deviations
    learner.update(20)
    weight = learned["transition"].module["transition"].module.weight
    torch.testing.assert_close(weight[:, :2], torch.zeros(2, 2), atol=0.07, rtol=0)
    test = hike.MountainHike(100, 0.8, seed=1).rollout(hike.STEPS)

    def error(filter):
        return (refiltered(filter, test)["next", "belief", "mean"] - test["next", "state"]).square().mean().sqrt()

    assert error(learned) < 1.4 * error(exact)


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


def test_missing_readings_put_the_noise_too_and_teach():
    """Two neighbours came in a quarter of the steps: 2,400 differences, of which 0.01 is 2 standard deviations."""
    torch.manual_seed(0)
    filter = hike.unlearned_filter(8)
    learner = Learner(filter, TASKS["hike"].prior, 32, TASKS["hike"].learning)
    learner.add(hike.MountainHike(32, 0.4, missing=0.5, seed=0).rollout(hike.STEPS))
    steps = hike.STRIDE**2 / 3 + hike.PROCESS**2
    noise = filter["noise"].log_variance.exp()
    torch.testing.assert_close(noise, torch.full((2,), 0.4**2 + steps / 2), atol=0.02, rtol=0)
    before = torch.nn.utils.parameters_to_vector(filter.parameters())
    assert math.isfinite(learner.update(2))
    after = torch.nn.utils.parameters_to_vector(filter.parameters())
    assert after.isfinite().all()
    assert (after - before).abs().max() > 1e-3


def test_whole_episodes_begin_as_the_filter_does_and_windows_anywhere():
    """Of 4 steps a window of 3 begins at two places, with the prior of a state anywhere in an episode."""
    torch.manual_seed(0)
    prior, data = TASKS["hike"].prior, hike.MountainHike(4, 0.2).rollout(4)
    data["observation"] = data["step"].expand(-1, -1, 2).float()
    for window, starts in ((None, {(0, 1, 2, 3)}), (3, {(0, 1, 2), (1, 2, 3)})):
        filter, seen = hike.unlearned_filter(5), set()
        learner = Learner(filter, prior, 4, Learning(window=window, windows=4))
        begin = learner.loss.filter.initial
        mean, std = ((0.0, 0.0), (hike.START_STD,) * 2) if window is None else prior
        assert begin.mean.equal(torch.tensor(mean))
        assert begin.std.equal(torch.tensor(std))
        assert begin.ensemble_size == 5

        def loss(windows, seen=seen, filter=filter):
            seen |= {tuple(steps) for steps in windows["observation"][..., 0].int().tolist()}
            return {"loss": sum(parameter.sum() for parameter in filter.parameters())}

        learner.loss = loss
        learner.add(data)
        learner.update(12)
        assert seen == starts


def test_whole_episodes_are_not_cut_into_pieces():
    with pytest.raises(ValueError, match=r"window=None takes whole episodes: give pieces=1, not 10"):
        Learning(window=None, pieces=10)


def test_a_taught_filter_learns_the_pendulum():
    """Half of the error of the velocity that the untaught filter has."""
    torch.manual_seed(0)
    filter = pendulum.unlearned_filter(16)
    learner = Learner(filter, TASKS["pendulum"].prior, 16, Learning(), taught=True)
    learner.add(pendulum.world(16, 0.1, 0.0, 0).rollout(100))
    test = pendulum.world(16, 0.1, 0.0, 1).rollout(100).exclude("next")

    def error():
        with torch.no_grad():
            out = filter.sequence(test.copy())
        return (out["belief", "mean"] - out["state"])[:, 10:, 2].square().mean().sqrt().item()

    before = error()
    learner.update(60)
    assert error() < 0.5 * before
