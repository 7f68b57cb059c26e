"""Oracles: finite differences; training lowers the loss."""

import pytest
import torch

from tests.filters.differences_for_tests import check_largest_gradients
from tests.filters.factories import toy_denkf
from tests.objectives.denkf_for_tests import ONLY_STATE
from tests.objectives.problem_for_tests import problem
from torch_denkf.objectives import DEnKFLoss


@pytest.mark.parametrize(
    ("score", "layer"), [("crps", "dropout"), ("crps", "flipout"), ("energy", "dropout"), ("mse", "dropout")]
)
def test_gradient_by_finite_differences(float64, score, layer):
    filter = toy_denkf("sensor", layer)
    frames, _ = problem(filter)
    loss = DEnKFLoss(filter, score=score, **ONLY_STATE)
    loss(frames)["loss_state"].backward()
    parts = [filter[name] for name in ("transition", "sensor", "observation", "noise")]
    # Central differences: 1e-12 of curvature, 1e-16 / 1e-6 = 1e-10 of rounding.
    assert check_largest_gradients(parts, lambda: loss(frames)["loss_state"], rtol=1e-5, atol=1e-8) > 7


def test_detach_every_reaches_the_filter(float64):
    filter = toy_denkf("etkf")
    frames, _ = problem(filter, resets=False, masks=0)

    def gradient(detach_every):
        loss = DEnKFLoss(filter, **ONLY_STATE, detach_every=detach_every)
        value = loss(frames)["loss_state"]
        return value, torch.autograd.grad(value, filter["transition"].module.layers[0].weight)[0]

    (full, full_grad), (cut, cut_grad) = gradient(None), gradient(2)
    assert full.equal(cut)
    assert not full_grad.allclose(cut_grad)
