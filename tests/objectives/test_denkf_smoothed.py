"""The loss of the smoothed belief: the smoother's own ensemble, scored by hand; finite differences."""

from functools import partial

import pytest
import torch

from tests.filters.factories import toy_denkf
from tests.objectives.denkf_for_tests import CLOSE, TERMS, score_by_hand
from tests.objectives.problem_for_tests import only, problem, stepped
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.smoothers import EnKS, EnRTS

SMOOTHERS = {"EnRTS": EnRTS, "lag": partial(EnRTS, lag=2), "EnKS": partial(EnKS, lag=2)}


@pytest.mark.parametrize("name", SMOOTHERS)
def test_scores_by_hand(float64, name):
    filter = toy_denkf("perturbed", ensemble_size=6)
    frames, out = problem(filter)
    terms = {**only(TERMS, "state"), "smoothed": 2.0, "smoother": SMOOTHERS[name]}
    losses = DEnKFLoss(filter, **terms)(frames)
    smoothed = SMOOTHERS[name](filter)(frames.copy())["smoothed", "ensemble"]
    expected = score_by_hand("crps", smoothed, frames["state"])[stepped(frames)].mean()
    torch.testing.assert_close(losses["loss_smoothed"], 2 * expected, **CLOSE)
    filtered = score_by_hand("crps", out["belief", "ensemble"], frames["state"])[stepped(frames)].mean()
    torch.testing.assert_close(losses["loss_state"], filtered, **CLOSE)


def test_gradient_is_that_of_finite_differences(float64):
    filter = toy_denkf("perturbed", layer="none", sensor_layer="none", ensemble_size=6)
    frames, _ = problem(filter)
    loss = DEnKFLoss(filter, **only(TERMS), smoothed=1.0, smoother=EnRTS)
    weight = filter["sensor"].module[-1].weight if hasattr(filter["sensor"].module, "__getitem__") else None
    parameters = [weight] if weight is not None else list(filter["transition"].parameters())[:2]
    value = loss(frames)["loss_smoothed"]
    gradients = torch.autograd.grad(value, parameters)
    direction = [torch.randn_like(p) for p in parameters]
    values = []
    with torch.no_grad():
        for size in (1e-6, -2e-6):
            for parameter, way in zip(parameters, direction, strict=True):
                parameter.add_(size * way)
            values.append(loss(frames)["loss_smoothed"])
    expected = (values[0] - values[1]) / 2e-6
    got = sum((g * d).sum() for g, d in zip(gradients, direction, strict=True))
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-8)


def test_it_has_the_parameters_of_the_filter_alone():
    filter = toy_denkf("perturbed")
    loss = DEnKFLoss(filter, smoothed=1.0, smoother=EnRTS)
    assert set(loss.parameters()) == set(filter.parameters())
    assert loss.state_dict().keys() == DEnKFLoss(filter).state_dict().keys()
    assert "loss_smoothed" in loss.out_keys


def test_without_a_smoother_it_says_what_to_give():
    with pytest.raises(ValueError, match="smoother=EnRTS"):
        DEnKFLoss(toy_denkf(), smoothed=1.0)
