"""Oracles: each term worked out by hand from the filter's own outputs, the joint Gaussian."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_kalman, toy_denkf
from tests.filters.test_kalman import joint_gaussian
from tests.objectives.denkf_for_tests import CLOSE, TERMS, score_by_hand
from tests.objectives.problem_for_tests import only, problem
from torch_denkf.modules import StochasticMLP
from torch_denkf.objectives import DEnKFLoss


def test_every_element_counts_for_the_sensor_without_a_mask(float64):
    filter = toy_denkf()
    frames, out = problem(filter, masks=0)
    expected = score_by_hand("crps", out["sensor", "ensemble"], frames["target_observation"]).mean()
    torch.testing.assert_close(DEnKFLoss(filter)(frames)["loss_sensor"], expected, **CLOSE)


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
