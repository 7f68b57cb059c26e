"""Presets, keys, parameters and errors; known observation models give the target."""

import pytest
import torch

from tests.filters.factories import toy_denkf
from tests.objectives.denkf_for_tests import CLOSE, ONLY_STATE, score_by_hand
from tests.objectives.problem_for_tests import problem, stepped
from torch_denkf.objectives import DEnKFLoss, MixtureLoss, SensorLoss, TransitionLoss


def test_paper_preset(float64):
    filter = toy_denkf()
    frames, out = problem(filter)
    losses = DEnKFLoss.paper(filter)(frames)
    assert set(losses.keys()) == {"loss_state", "loss_transition", "loss_sensor"}
    expected = (out["belief", "mean"] - frames["state"]).square().mean(-1)[stepped(frames)].mean()
    torch.testing.assert_close(losses["loss_state"], expected, **CLOSE)
    assert set(DEnKFLoss.paper(filter, sensor=0.0)(frames).keys()) == {"loss_state", "loss_transition"}


def test_set_keys(float64):
    filter = toy_denkf()
    frames, _ = problem(filter)
    renamed = frames.copy()
    for old, new in (("state", ("truth", "x")), ("target_observation", "y"), ("observed", "seen")):
        renamed[new] = renamed[old]
    renamed = renamed.exclude("state", "target_observation")
    loss = DEnKFLoss(filter)
    expected = loss(frames)
    loss.set_keys(state=("truth", "x"), target_observation="y", observed="seen")
    out = loss(renamed)
    assert all(out[key].equal(expected[key]) for key in list(expected.keys()))
    assert ("truth", "x") in loss.in_keys
    with pytest.raises(ValueError, match="DEnKFLoss reads no 'reward'; set_keys takes state, "):
        loss.set_keys(reward="r")


def test_score_of_other_entries(float64):
    filter = toy_denkf()
    frames, out = problem(filter)
    loss = DEnKFLoss(filter, **ONLY_STATE)
    loss.set_keys(belief=("forecast", "ensemble"))
    expected = score_by_hand("crps", out["forecast", "ensemble"], frames["state"])[stepped(frames)].mean()
    torch.testing.assert_close(loss(frames)["loss_state"], expected, **CLOSE)


@pytest.mark.parametrize("loss", [DEnKFLoss, SensorLoss, TransitionLoss, MixtureLoss])
def test_a_filter_with_a_prefix_has_the_same_terms(float64, loss):
    losses = []
    for prefix in (None, "imu"):
        torch.manual_seed(0)
        filter = toy_denkf(prefix=prefix)
        frames, _ = problem(filter)
        losses.append(loss(filter)(frames))
    assert list(losses[0].keys()) == list(losses[1].keys())
    assert all(losses[0][key].equal(losses[1][key]) for key in losses[0].keys())  # noqa: SIM118
