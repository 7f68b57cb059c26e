"""Losses of one part. Oracles: the whole loss, scores by hand, densities by torch.distributions, single steps."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import MultivariateNormal, Normal

from tests.filters.differences_for_tests import central_difference
from tests.filters.factories import OBS, E, S, linear_denkf, linear_kalman, linear_system, toy_denkf
from tests.filters.gaussian_for_tests import learned_filter, learned_frames
from tests.filters.particle_for_tests import toy_filter
from tests.objectives.denkf_for_tests import CLOSE, TERMS, score_by_hand
from tests.objectives.problem_for_tests import only, problem, stepped
from torch_denkf.baselines import LSTMFilter
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, ObservationLoss, SensorLoss, TransitionLoss


@pytest.fixture(autouse=True)
def _double(float64):
    return


def check_gradient(loss, frames, filter, modules):
    """That part has a gradient, checked by differences, and is all that the loss has parameters of."""
    value = lambda: sum(loss(frames).values())  # noqa: E731
    filter.zero_grad()
    value().backward()
    own = {id(p) for module in modules for p in module.parameters()}
    assert {id(p) for p in loss.parameters()} == own
    names = {name for name, _ in loss.named_parameters()}
    assert names == {f"filter.{name}" for name, p in filter.named_parameters() if id(p) in own}
    checked = 0
    for parameter in filter.parameters():
        if id(parameter) not in own:
            assert parameter.grad is None
        elif parameter.grad is not None and parameter.grad.any():
            entry = int(parameter.grad.abs().argmax())
            difference = central_difference(value, parameter, entry)
            torch.testing.assert_close(parameter.grad.view(-1)[entry], difference, rtol=1e-5, atol=1e-8)
            checked += 1
    assert checked >= 2


# ---------------------------------------------------------------------------------------------------- sensor


@pytest.mark.parametrize("score", ["crps", "energy", "mse"])
def test_the_sensor_alone_is_the_term_of_the_whole(score):
    filter = toy_denkf()
    frames, out = problem(filter, masks=OBS)
    scale = torch.tensor([2.0, 0.5])
    loss = SensorLoss(filter, score=score, observation_scale=scale)
    whole = DEnKFLoss(filter, score=score, **only(TERMS, "sensor"), observation_scale=scale)
    value = loss(frames)["loss_sensor"]
    assert loss.out_keys == ["loss_sensor"]
    torch.testing.assert_close(value, whole(frames)["loss_sensor"], **CLOSE)
    expected = score_by_hand(score, out["sensor", "ensemble"] / scale, frames["target_observation"] / scale)
    torch.testing.assert_close(value, expected[frames["observed"].all(-1)].mean(), **CLOSE)
    # The order of frames is nothing to it: no action, no start, no state.
    flat = frames.select("measurement", "observed", "target_observation", "noise").reshape(14)[torch.randperm(14)]
    torch.testing.assert_close(loss(flat)["loss_sensor"], value, **CLOSE)
    check_gradient(loss, frames, filter, [filter["sensor"]])


def test_the_noise_model_by_its_likelihood():
    filter = toy_denkf()
    with torch.no_grad():
        for parameter in filter["noise"].parameters():  # or R would be the same everywhere
            parameter.add_(0.3 * torch.randn_like(parameter))
    frames, out = problem(filter)
    density = Normal(out["sensor", "ensemble"].mean(-2), out["sensor", "noise"].sqrt())
    each = density.log_prob(frames["target_observation"])
    seen = frames["observed"].all(-1)
    for scale, dims in ((None, [0, 1]), ([3.0, 0.2], [0, 1]), ([math.inf, 0.2], [1])):
        loss = SensorLoss(filter, sensor=0.0, noise=0.5, observation_scale=scale)
        expected = -0.5 * each[..., dims].sum(-1)[seen].mean()
        torch.testing.assert_close(loss(frames)["loss_noise"], expected, **CLOSE)
    check_gradient(loss, frames, filter, [filter["sensor"], filter["noise"]])


def test_a_full_covariance_of_the_noise():
    filter, frames = learned_filter("EKF"), learned_frames(3, 4)
    frames["target_observation"] = torch.randn(3, 4, 2)
    out = filter.sequence(frames.copy())
    assert out["sensor", "noise"].shape == (3, 4, 2, 2)
    density = MultivariateNormal(out["sensor", "ensemble"].mean(-2), out["sensor", "noise"])
    expected = -density.log_prob(frames["target_observation"])[frames["observed"].all(-1)].mean()
    losses = SensorLoss(filter, noise=1.0, observation_scale=[3.0, 0.2])(frames)
    torch.testing.assert_close(losses["loss_noise"], expected, rtol=1e-10, atol=0)
    whole = GaussianLoss(filter, state=0.0, transition=0.0, observation_scale=[3.0, 0.2])(frames)
    torch.testing.assert_close(losses["loss_sensor"], whole["loss_sensor"], **CLOSE)


# ----------------------------------------------------------------------------------------------- observation


def test_the_observation_alone_is_the_term_of_the_whole():
    filter = toy_denkf()
    frames, _ = problem(filter)
    kwargs = {"observation_scale": [math.inf, 4.0]}
    loss = ObservationLoss(filter, **kwargs)
    expected = DEnKFLoss(filter, **only(TERMS, "observation"), **kwargs)(frames)["loss_observation"]
    error = filter["observation"].module(frames["state"]) - frames["target_observation"]
    torch.testing.assert_close(expected, (error[..., 1] / 4).square().mean(), **CLOSE)
    pairs = frames.select("state", "target_observation").reshape(14)
    assert set(loss.in_keys) == {"state", "target_observation"}
    torch.testing.assert_close(loss(pairs)["loss_observation"], expected, **CLOSE)
    check_gradient(loss, pairs, filter, [filter["observation"]])
    with pytest.raises(KeyError, match="no observation model"):
        ObservationLoss(LSTMFilter(None, state_dim=S, observation_dim=OBS, observation_key="y"))(pairs)


# ------------------------------------------------------------------------------------------------ transition


def forecasts_by_hand(filter, frames):
    """Runs the transition on a TensorDict, one element and one time after the other."""
    out = torch.zeros(2, 7, E, S)
    for b in range(2):
        for t in range(1, 7):
            step = frames[b, t].select("noise")
            step["noise"] = step["noise"].select("transition")
            step["noise", "self"] = step["noise", "transition"]
            step["belief", "ensemble"] = frames["state"][b, t - 1].expand(E, S)
            step["action"] = frames["action"][b, t - 1]
            out[b, t] = filter["transition"](step)["forecast", "ensemble"]
    return out


@pytest.mark.parametrize("score", ["crps", "energy", "mse"])
def test_the_transition_from_true_states_by_hand(score):
    filter = toy_denkf()
    frames, _ = problem(filter)
    scale = torch.tensor([2.0, 0.5, 3.0])
    loss = TransitionLoss(filter, score=score, state_scale=scale)
    expected = score_by_hand(score, forecasts_by_hand(filter, frames) / scale, frames["state"] / scale)
    value = loss(frames)["loss_transition"]
    torch.testing.assert_close(value, expected[stepped(frames)].mean(), **CLOSE)
    assert loss.in_keys == ["action", "state"]
    frames["measurement"].fill_(torch.nan)  # it sees nothing of the sensor
    assert loss(frames)["loss_transition"].equal(value)
    check_gradient(loss, frames, filter, [filter["transition"]])
    # Flat, where is_init marks the starts.
    torch.testing.assert_close(loss(frames.reshape(14))["loss_transition"], value, **CLOSE)


def test_resets_and_padding_are_not_scored():
    filter = toy_denkf(layer="none")
    frames, _ = problem(filter)
    loss = TransitionLoss(filter, score="mse", reduction="none")
    value = loss(frames)["loss_transition"]
    assert (value != 0).equal(stepped(frames))
    frames["is_init"][:, 5:] = False
    frames["collector", "mask"] = torch.ones(2, 7, dtype=torch.bool)
    frames["collector", "mask"][0, 5:] = False
    mean = TransitionLoss(filter, score="mse")
    before = mean(frames)["loss_transition"]
    frames["state"][0, 5:] = torch.nan
    after = mean(frames)["loss_transition"]
    assert before.equal(after)
    after.backward()
    assert all(p.grad.isfinite().all() for p in mean.parameters())


def test_a_spread_around_the_truth_of_a_linear_ensemble_is_the_gaussian():
    # Many members around the truth against the closed form: F spread² F' + Q in a Kalman filter.
    frames = TensorDict({"state": torch.randn(4, 6, 2)}, [4, 6])
    kwargs = {"spread": [0.7, 0.2], "state_scale": [2.0, 0.5]}
    exact = TransitionLoss(linear_kalman(), **kwargs)(frames)["loss_transition"]
    many = TransitionLoss(linear_denkf(noisy=True), members=20_000, **kwargs)(frames)["loss_transition"]
    torch.testing.assert_close(many, exact, rtol=0, atol=0.02)  # 20 steps and 2 dimensions of 20,000 members


@pytest.mark.parametrize("score", ["crps", "nll", "mse"])
@pytest.mark.parametrize("name", ["EKF", "UKF", "BackpropKF"])
def test_filters_with_a_mean_and_a_covariance(name, score):
    filter, frames = learned_filter(name), learned_frames(2, 5)
    frames["state"] = torch.randn(2, 5, 3)
    frames["is_init"][:, 1:] = False
    check_gradient(TransitionLoss(filter, score=score, spread=0.1), frames, filter, [filter["transition"]])


def test_the_density_of_one_step():
    F, Q, _, _ = linear_system()
    frames = learned_frames(2, 5).select("action")
    frames["state"] = torch.randn(2, 5, 2)
    state, spread = frames["state"], torch.tensor([0.3, 0.6])
    density = MultivariateNormal(state[:, :-1] @ F.mT, F @ spread.square().diag() @ F.mT + Q)
    expected = -density.log_prob(state[:, 1:]).mean()
    for scale in (None, [0.1, 20.0]):
        loss = TransitionLoss(linear_kalman(), score="nll", spread=spread, state_scale=scale)
        torch.testing.assert_close(loss(frames)["loss_transition"], expected, rtol=1e-11, atol=0)
    marginal = Normal(density.mean[..., 1], density.covariance_matrix[..., 1, 1].sqrt())
    loss = TransitionLoss(linear_kalman(), score="nll", spread=spread, state_scale=[math.inf, 20.0])
    value = loss(frames)["loss_transition"]
    torch.testing.assert_close(value, -marginal.log_prob(state[:, 1:, 1]).mean(), rtol=1e-11, atol=0)


def test_particles_start_with_equal_weights():
    filter = toy_filter("soft")
    frames, _ = problem(filter, resets=False)
    check_gradient(TransitionLoss(filter), frames, filter, [filter["transition"]])
