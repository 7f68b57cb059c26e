"""Oracles: each term worked out by hand from the filter's own outputs, the joint Gaussian."""

import math

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_kalman, toy_denkf
from tests.filters.test_kalman import joint_gaussian
from tests.objectives.denkf_for_tests import CLOSE, ONLY_STATE, TERMS, score_by_hand
from tests.objectives.problem_for_tests import only, problem, stepped
from torch_denkf.functional.manifolds import Flat
from torch_denkf.modules import StochasticMLP
from torch_denkf.objectives import DEnKFLoss


def test_every_element_counts_for_the_sensor_without_a_mask(float64):
    filter = toy_denkf()
    frames, out = problem(filter, masks=0)
    expected = score_by_hand("crps", out["sensor", "ensemble"], frames["target_observation"]).mean()
    torch.testing.assert_close(DEnKFLoss(filter)(frames)["loss_sensor"], expected, **CLOSE)


def test_nll_by_hand(float64):
    filter = toy_denkf()
    frames, out = problem(filter)
    expected = -out["info", "log_likelihood"].squeeze(-1)[stepped(frames)].mean()
    losses = DEnKFLoss(filter, **only(TERMS, "nll"))(frames.exclude("state", "target_observation"))
    assert list(losses.keys()) == ["loss_nll"]
    torch.testing.assert_close(losses["loss_nll"], expected, **CLOSE)


@pytest.mark.parametrize("update_at_reset", [False, True])
def test_nll_of_a_kalman_filter_is_the_joint_density(float64, update_at_reset):
    T = 10
    kf = linear_kalman(update_at_reset=update_at_reset)
    readings = torch.randn(3, T, 2)
    loss = DEnKFLoss(kf, **only(TERMS, "nll"), reduction="sum")
    joint = joint_gaussian(kf, T)
    if update_at_reset:  # the first reading is given
        first = torch.distributions.MultivariateNormal(joint.mean[:2], joint.covariance_matrix[:2, :2])
        expected = joint.log_prob(readings.reshape(3, -1)) - first.log_prob(readings[:, 0])
    else:  # the first reading is not used
        rest = torch.distributions.MultivariateNormal(joint.mean[2:], joint.covariance_matrix[2:, 2:])
        expected = rest.log_prob(readings[:, 1:].reshape(3, -1))
    value = loss(TensorDict({"observation": readings}, [3, T]))["loss_nll"]
    torch.testing.assert_close(value, -expected.sum(), rtol=1e-11, atol=0)


def test_kl_by_hand(float64):
    filter = toy_denkf(layer="flipout", sensor_layer="flipout")
    frames, _ = problem(filter)
    nets = [net for net in filter.modules() if isinstance(net, StochasticMLP)]
    expected = sum(net.kl() for net in nets)
    assert sum(net.layer == "flipout" for net in nets) == 2
    losses = DEnKFLoss(filter, **only(TERMS, "kl", 0.01))(frames)
    torch.testing.assert_close(losses["loss_kl"], 0.01 * expected, **CLOSE)
    assert DEnKFLoss(toy_denkf(), **only(TERMS, "kl"))(problem(toy_denkf())[0])["loss_kl"] == 0


def test_weights_scale_the_terms(float64):
    filter = toy_denkf(layer="flipout")
    frames, _ = problem(filter)
    ones = DEnKFLoss(filter, **dict.fromkeys(TERMS, 1.0))(frames)
    weights = dict(zip(TERMS, (0.5, 2.0, 3.0, 0.1, 7.0, 1e-3), strict=True))
    weighted = DEnKFLoss(filter, **weights)(frames)
    for name, weight in weights.items():
        torch.testing.assert_close(weighted[f"loss_{name}"], weight * ones[f"loss_{name}"], **CLOSE)
    assert DEnKFLoss(filter, **weights).out_keys == [f"loss_{name}" for name in TERMS]


# -------------------------------------------------------------------------------------------- units and angles


@pytest.mark.parametrize("score", ["crps", "energy", "mse"])
def test_angles_wrap(float64, score):
    filter = toy_denkf()
    frames, out = problem(filter)
    frames["state"] = out["belief", "ensemble"][..., 0, :].detach() + 0.1  # near: no error exceeds pi
    assert (out["belief", "ensemble"] - frames["state"].unsqueeze(-2)).abs().max() < math.pi
    near = DEnKFLoss(filter, score=score, **ONLY_STATE, space=Flat(3, circular=[1]))(frames)["loss_state"]
    expected = score_by_hand(score, out["belief", "ensemble"], frames["state"])[stepped(frames)].mean()
    torch.testing.assert_close(near, expected, **CLOSE)
    turned = frames.clone()
    turned["state"][..., 1] += 2 * math.pi * torch.randint(-3, 4, (2, 7))
    far = DEnKFLoss(filter, score=score, **ONLY_STATE, space=Flat(3, circular=[1]))(turned)["loss_state"]
    torch.testing.assert_close(far, near, rtol=1e-9, atol=1e-12)  # 6 pi costs a digit
    plain = DEnKFLoss(filter, score=score, **ONLY_STATE)(turned)["loss_state"]
    assert plain > near + 1
    turned["state"][..., 0] += 2 * math.pi  # not an angle
    assert DEnKFLoss(filter, score=score, **ONLY_STATE, space=Flat(3, circular=[1]))(turned)["loss_state"] > near + 0.5
