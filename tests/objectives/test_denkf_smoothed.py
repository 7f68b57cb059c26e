"""The loss of the smoothed belief: the smoother's own ensemble, scored by hand; finite differences."""

from functools import partial

import pytest
import torch

from tests.filters.factories import toy_denkf
from tests.filters.gaussian_for_tests import directional_check
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
    with torch.no_grad():  # the noise network starts at zero, where much of its gradient is zero, too
        for parameter in filter["noise"].parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    frames, _ = problem(filter)
    loss = DEnKFLoss(filter, **only(TERMS, "none"), smoothed=1.0, smoother=EnRTS)
    directional_check(lambda: loss(frames)["loss_smoothed"], filter.parameters(), step=1e-7, rtol=1e-4)
