"""Ensemble smoothers against the exact one, and against each other."""

import pytest
import torch
from torch.testing import assert_close

from tests.filters.factories import (
    FixedEnsemble,
    NoisyLinear,
    linear_denkf,
    linear_kalman,
    parts_of_reading,
    toy_denkf,
    toy_frames,
)
from tests.functional.checks import assert_raises
from tests.smoothers.joint import COV, MEAN, drive, joint_beliefs
from torch_denkf.filters import DEnKF, Filter
from torch_denkf.functional.moments import ensemble_cov
from torch_denkf.functional.smoothing.ensemble import enrts_smooth, enrts_step
from torch_denkf.modules import EnsembleAnalysis, GaussianPrior, LinearObservation
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, RTSSmoother

MEMBERS = 10_000
SMOOTHERS = {"EnKS": EnKS, "EnRTS": EnRTS}


def large_filter(scheme, **kwargs):
    """Returns the linear system with so many members that sampling errors are small."""
    prior = GaussianPrior(MEAN, torch.tensor(COV).sqrt(), ensemble_size=MEMBERS)
    return linear_denkf(scheme, noisy=True, initial=prior, **kwargs)


@pytest.mark.parametrize(("lag", "scheme"), [(None, "perturbed"), (None, "etkf"), (2, "perturbed")])
@pytest.mark.parametrize("name", SMOOTHERS)
def test_many_members_are_the_exact_smoother(float64, name, scheme, lag):
    frames = drive(2, 8)
    mean, cov = joint_beliefs(frames, lag)
    with torch.no_grad():
        out = SMOOTHERS[name](large_filter(scheme), lag)(frames)
    std = cov.diagonal(dim1=-2, dim2=-1).sqrt()
    # The error of a mean of E draws is std / sqrt(E), that of a covariance about std std sqrt(2 / E); the gains of all
    # steps have errors of that size, too. Five of them in each of 2 x 8 x (2 + 4) numbers.
    far = {kind: (out[kind, "mean"] - mean).abs() > 5 * std / MEMBERS**0.5 for kind in ("smoothed", "belief")}
    assert not far["smoothed"].any()
    assert far["belief"].float().mean() > 0.5, "the bound tells a smoother from a filter"
    tolerance = 5 * (2 / MEMBERS) ** 0.5 * std.unsqueeze(-1) * std.unsqueeze(-2)
    assert ((ensemble_cov(out["smoothed", "ensemble"]) - cov).abs() <= tolerance).all()
    assert_close(out["smoothed", "var"], ensemble_cov(out["smoothed", "ensemble"]).diagonal(dim1=-2, dim2=-1))


def test_members_with_the_exact_moments_give_the_exact_means(float64):
    """A few members whose sample moments are exact, no noise: EnKS, EnRTS and the exact smoother agree to rounding."""
    generator = torch.Generator().manual_seed(1)
    members = torch.randn(6, 2, generator=generator)
    members = members - members.mean(0)
    members = members @ torch.linalg.inv(torch.linalg.cholesky(ensemble_cov(members))).mT
    members = torch.tensor(MEAN) + members * torch.tensor(COV).sqrt()
    filter = linear_denkf("etkf")
    filter.initial.members.copy_(members)
    kalman = linear_kalman()
    kalman["transition"].noise.zero_()
    frames = drive(3, 7)
    exact = RTSSmoother(kalman)(frames.copy())
    for smoother in (EnKS(filter), EnRTS(filter)):
        out = smoother(frames.copy())
        assert_close(out["smoothed", "mean"], exact["smoothed", "mean"], rtol=0, atol=1e-9)
        assert_close(ensemble_cov(out["smoothed", "ensemble"]), exact["smoothed", "cov"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("scheme", ["sensor", "perturbed", "etkf", "sakov"])
def test_step_by_step_is_the_recording(float64, scheme):
    """Equals EnKS at t what FixedLag says at t + lag; at the end of an episode, what is there by then."""
    filter, lag = toy_denkf(scheme), 3
    frames = toy_frames([2, 9], resets=False)
    frames["is_init"] = torch.zeros(2, 9, 1, dtype=torch.bool)
    frames["is_init"][:, 0], frames["is_init"][0, 5] = True, True
    online = FixedLag(filter, lag)
    frames = online.draw_noise(frames)
    steps = online.sequence(frames.copy())
    whole = EnKS(filter, lag)(frames.copy())
    for row, ends in enumerate(([5] * 5 + [9] * 4, [9] * 9)):
        for t in range(9):
            later = min(t + lag, ends[t] - 1)
            if later == t:
                expected = steps["belief", "ensemble"][row, t]
            else:
                expected = steps["belief", "past"][row, later, :, later - t - 1]
            assert_close(whole["smoothed", "ensemble"][row, t], expected, rtol=0, atol=0)
            if later == t + lag:
                assert_close(steps["smoothed", "ensemble"][row, later], expected, rtol=0, atol=0)
    assert_close(whole["belief", "ensemble"], filter.sequence(frames.copy())["belief", "ensemble"], rtol=0, atol=0)


def test_rotation_applies_to_clones(float64):
    """Without process noise the rotated smoother keeps the exact moments, which a lag window left behind would not."""
    filter = linear_denkf("etkf")
    rotated = linear_denkf("etkf")
    rotated["analysis"].rotate = True
    frames = drive(2, 7)
    plain, turned = EnKS(filter)(frames.copy()), EnKS(rotated)(frames.copy())
    assert_close(turned["smoothed", "mean"], plain["smoothed", "mean"], rtol=0, atol=1e-9)
    assert_close(turned["smoothed", "var"], plain["smoothed", "var"], rtol=0, atol=1e-9)
    assert not torch.allclose(turned["smoothed", "ensemble"], plain["smoothed", "ensemble"])
    assert_raises(ValueError, "rotate=True", EnRTS, rotated)


def test_several_analyses_correct_the_clones(float64):
    """Two readings one after the other are the two at once, for the lag window as for the present."""
    both = linear_denkf("etkf")
    first = parts_of_reading(0, "forecast", "mid", observed_key="observed0")
    second = parts_of_reading(1, "mid", "belief", observed_key="observed1")
    split = Filter({"transition": both["transition"], **first, **second}, initial=both.initial)
    frames = drive(2, 6, missing=0.0, resets=False)
    frames.update({f"y{i}": frames["observation"][..., i : i + 1] for i in range(2)})
    frames.update({f"observed{i}": frames["observed"][..., i : i + 1] for i in range(2)})
    joint, serial = EnKS(both, 3)(frames.copy()), EnKS(split, 3)(frames.copy())
    assert_close(serial["smoothed", "mean"], joint["smoothed", "mean"], rtol=0, atol=1e-9)
    assert_close(serial["smoothed", "var"], joint["smoothed", "var"], rtol=0, atol=1e-9)


def test_inflation_does_not_change_clones(float64):
    filter = linear_denkf("etkf")
    out = FixedLag(filter, 2).sequence(drive(2, 3, resets=False, missing=0.0))
    filter["analysis"].inflation = 1.5
    inflated = FixedLag(filter, 2).sequence(drive(2, 3, resets=False, missing=0.0))
    first = ("belief", "past")
    assert_close(inflated[first][:, 1, :, 0], out[first][:, 1, :, 0], rtol=0, atol=0)
    assert not torch.allclose(inflated["belief", "ensemble"][:, 1], out["belief", "ensemble"][:, 1])


def test_damping_limits_the_backward_inflation(float64):
    """One direction that is never read, inflated in each step: the way back multiplies it, unless it is damped."""
    members = torch.randn(6, 1)
    members = members - members.mean()
    beliefs = torch.stack([1.5**t * members for t in range(5)])
    forecasts = beliefs / 1.5  # the motion keeps them; the analysis only inflates
    first = [enrts_smooth(beliefs, forecasts, damping=damping)[0] for damping in (1.0, 0.5)]
    torch.testing.assert_close(first[0], 1.5**4 * members, rtol=1e-9, atol=0)
    shift = sum(0.5**k * 1.5 ** (k - 1) * 0.5 for k in range(1, 5))  # of each step k, through k damped gains
    torch.testing.assert_close(first[1], (1 + shift) * members, rtol=1e-9, atol=0)
    assert_raises(ValueError, "above 0 and at most 1", enrts_step, members, members, members, damping=0.0)


@pytest.mark.parametrize("lag", [None, 1])
def test_inflation_needs_a_damping(float64, lag):
    """In an unobserved direction the smoothed spread is not the filter's times the inflation."""
    frames = drive(2, 8, missing=0.0, resets=False)
    filter = DEnKF(
        NoisyLinear(torch.eye(2)),
        None,
        LinearObservation(torch.tensor([[1.0, 0.0], [2.0, 0.0]])),
        linear_denkf("etkf")["noise"],
        EnsembleAnalysis("etkf", observation_key="observation"),
        initial=FixedEnsemble(torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])),
    )
    unread = lambda out, key: out[key, "ensemble"][..., 1].std(-1)  # noqa: E731
    still = EnRTS(filter, lag)
    first = still(frames.copy())
    assert_close(unread(first, "smoothed"), unread(first, "belief"), rtol=1e-9, atol=0)
    filter["analysis"].inflation = 1.2
    for make in (lambda: EnRTS(filter, lag), lambda: still(frames.copy())):  # now, and set since it was made
        assert_raises(ValueError, r"EnsembleAnalysis has inflation=1.2.*damping=.*EnKS or FixedLag", make)
    carried = EnRTS(filter, lag, damping=1.0)(frames.copy())
    assert (unread(carried, "smoothed")[:, 1:-1] > 1.19 * unread(carried, "belief")[:, 1:-1]).all()
    EnRTS(filter, lag, damping=0.8)(frames.copy())
    past = EnKS(filter, lag)(frames.copy())  # leaves it out
    assert_close(unread(past, "smoothed"), unread(past, "belief"), rtol=1e-9, atol=0)
    filter["analysis"].inflation = 0.9  # what shrinks does not grow on the way back
    EnRTS(filter, lag)(frames.copy())


@pytest.mark.parametrize("size", [4, 7])
def test_gradients_of_a_step_are_those_of_finite_differences(float64, size):
    """In state space (fewer dimensions than members) and in the members' space."""
    generator = torch.Generator().manual_seed(0)
    shape = (2, size, 5)
    before, noise = (torch.randn(shape, generator=generator) for _ in range(2))
    forecast = before + 0.3 * noise
    # What a later reading does to members lies in the space that they span.
    weights = 0.1 * torch.randn(2, size, size, generator=generator)
    inputs = [value.requires_grad_() for value in (before, forecast, weights)]

    def smooth(before, forecast, weights):
        return enrts_step(before, forecast, forecast + weights @ (forecast - forecast.mean(-2, keepdim=True)))

    assert torch.autograd.gradcheck(smooth, inputs)
