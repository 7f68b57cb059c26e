"""Tests smoothers at borders: of episodes, of masks, of the batch, of what they can be made of."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.filters.factories import linear_denkf, linear_kalman, toy_denkf, toy_frames
from tests.filters.gaussian_for_tests import directional_check
from tests.filters.particle_for_tests import bootstrap
from tests.functional.checks import assert_raises
from tests.smoothers.joint import drive, joint_beliefs
from torch_denkf.baselines import LSTMFilter
from torch_denkf.functional.smoothing.ensemble import enrts_step
from torch_denkf.modules import GaussianPrior
from torch_denkf.monitoring import Gated
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, ParticleSmoother, RTSSmoother

KINDS = {
    "EnKS": EnKS,
    "EnKS 2": partial(EnKS, lag=2),
    "EnRTS": EnRTS,
    "EnRTS 2": partial(EnRTS, lag=2),
    "FixedLag": partial(FixedLag, lag=2),
}


def means(smoother, frames):
    return smoother.sequence(frames.copy())["smoothed", "mean"]


def noisy(smoother, frames):
    return getattr(smoother, "filter", smoother).draw_noise(frames)


@pytest.mark.parametrize("at_reset", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_episode_start_within_the_lag_resets_the_clones(float64, kind, at_reset):
    smoother = KINDS[kind](toy_denkf(update_at_reset=at_reset))
    frames = toy_frames([2, 9], resets=False)
    frames["is_init"] = torch.zeros(2, 9, 1, dtype=torch.bool)
    frames["is_init"][:, [0, 4, 5]] = True  # the second episode is a single frame
    frames = noisy(smoother, frames)
    apart = [means(smoother, frames[:, begin:end]) for begin, end in ((0, 4), (4, 5), (5, 9))]
    assert_close(means(smoother, frames), torch.cat(apart, 1), rtol=0, atol=1e-10)


@pytest.mark.parametrize("lag", [None, 2])
def test_gap_longer_than_the_lag(float64, lag):
    frames = drive(3, 14, missing=0.0, resets=False)
    frames["observed"][:, 4:11] = False
    frames["observation"][:, 4:11] = torch.nan
    mean, cov = joint_beliefs(frames, lag)
    out = RTSSmoother(linear_kalman(), lag)(frames.copy())
    assert_close(out["smoothed", "mean"], mean, rtol=0, atol=1e-10)
    assert_close(out["smoothed", "cov"], cov, rtol=0, atol=1e-10)
    if lag:
        online = FixedLag(linear_kalman(), lag).sequence(frames.copy())
        assert_close(online["smoothed", "mean"][:, lag:], mean[:, :-lag], rtol=0, atol=1e-10)
        for smoother in (EnKS, EnRTS):  # times 3 to 8 have nothing to learn from
            out = smoother(linear_denkf(), lag)(frames.copy())
            blind = slice(3, 11 - lag)
            assert_close(out["smoothed", "mean"][:, blind], out["belief", "mean"][:, blind], rtol=0, atol=1e-12)
            assert (out["smoothed", "mean"] - out["belief", "mean"])[:, 11 - lag].abs().max() > 0.01


@pytest.mark.parametrize("smoother", [EnKS, EnRTS, RTSSmoother])
def test_a_lag_beyond_the_end_is_all_of_it(float64, smoother):
    frames = drive(2, 6)
    filter = linear_kalman() if smoother is RTSSmoother else linear_denkf()
    assert_close(means(smoother(filter, 50), frames), means(smoother(filter), frames), rtol=0, atol=1e-12)
    first = smoother(filter, 3)(frames[:, :1].copy())
    assert_close(first["smoothed", "mean"], first["belief", "mean"], rtol=0, atol=0)


@pytest.mark.parametrize("size", [2, 3, 7, 8])
def test_identical_members_are_unchanged(float64, size):
    """Nothing can be learned without a spread; fewer members than dimensions take another path than more."""
    members = torch.randn(5).expand(size, 5).clone().requires_grad_()
    smoothed = enrts_step(members, 2 * members, 2 * members + 1)
    assert_close(smoothed, members, rtol=0, atol=0)
    (gradient,) = torch.autograd.grad(smoothed.sum(), members)
    assert gradient.isfinite().all()
    still = GaussianPrior(torch.zeros(3), torch.zeros(3), ensemble_size=size)
    filter = toy_denkf("etkf", layer="none", sensor_layer="none", ensemble_size=size, initial=still)
    for smoother in (EnKS(filter), EnRTS(filter)):
        out = smoother(toy_frames([2, 5]))
        assert_close(out["smoothed", "mean"], out["belief", "mean"], rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_with_gaps_and_new_episodes(float64, kind):
    """Readings that are missing are NaN; none of that reaches the gradient."""
    filter = toy_denkf(layer="none", ensemble_size=6)
    with torch.no_grad():  # the noise network starts at zero, where much of its gradient is zero, too
        for parameter in filter["noise"].parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    frames = toy_frames([2, 6])
    frames["measurement"] = torch.where(frames["observed"], frames["measurement"], torch.nan)
    smoother = KINDS[kind](filter)
    frames = noisy(smoother, frames)
    weights = torch.linspace(-1, 1, 36).reshape(2, 6, 3)
    directional_check(lambda: (means(smoother, frames) * weights).sum(), list(filter.parameters()), rtol=1e-4)


LSTM = partial(LSTMFilter, None, state_dim=2, observation_dim=2)
WRONG = [
    *((TypeError, "lag must be a whole number", partial(EnRTS, lag=lag), linear_denkf) for lag in (1.5, True, "2")),
    *((TypeError, "lag must be a whole number", partial(FixedLag, lag=lag), linear_denkf) for lag in (1.5, True, "2")),
    (ValueError, "at least 1", partial(FixedLag, lag=0), linear_denkf),
    (ValueError, "lag must be a whole number, at least 0; got -1", partial(EnRTS, lag=-1), linear_denkf),
    (ValueError, r"damping must be .*at most 1; got 1.2", partial(EnRTS, damping=1.2), linear_denkf),
    (TypeError, "damping must be a number", partial(EnRTS, damping="0.9"), linear_denkf),
    *((TypeError, "before and after a step", smoother, LSTM) for smoother in (partial(FixedLag, lag=2), RTSSmoother)),
    *((TypeError, "LSTMFilter carries", smoother, LSTM) for smoother in (EnKS, EnRTS)),
    (ValueError, r"adapt_inflation=0.1.*damping=", EnRTS, lambda: Gated(linear_denkf(), adapt_inflation=0.1)),
    (TypeError, "EnRTS takes a filter with an ensemble", EnRTS, linear_kalman),
    (TypeError, "EnKS takes a filter with an ensemble", EnKS, linear_kalman),
    (TypeError, "takes a filter with a mean and a covariance; DEnKF carries", RTSSmoother, linear_denkf),
    (TypeError, "takes a filter with particles", ParticleSmoother, linear_denkf),
    (TypeError, "density of the motion", ParticleSmoother, partial(bootstrap, 5)),
    (ValueError, "picks no particles", partial(FixedLag, lag=2), partial(bootstrap, 5, resampling="transport")),
    (TypeError, "already carries a lag window", partial(FixedLag, lag=2), lambda: FixedLag(linear_denkf(), 2)),
]


@pytest.mark.parametrize(("error", "words", "smoother", "make"), WRONG)
def test_unsupported_filters_raise(error, words, smoother, make):
    assert_raises(error, words, smoother, make())


def test_stored_belief_without_a_lag_raises():
    stored = linear_denkf().sequence(TensorDict({"observation": torch.zeros(4, 2)}, [4]))
    assert_raises(KeyError, "stored without a lag", FixedLag(linear_denkf(), 2).sequence, stored)
