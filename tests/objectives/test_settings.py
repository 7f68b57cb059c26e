"""Infinite scales. Oracle: the loss without those dimensions, by hand."""

import math

import pytest
import torch

from tests.filters.factories import toy_denkf
from tests.objectives.denkf_for_tests import CLOSE, ONLY_STATE, score_by_hand
from tests.objectives.problem_for_tests import problem, stepped
from torch_denkf.functional.manifolds import Flat
from torch_denkf.objectives import DEnKFLoss, SensorLoss, TransitionLoss

SCORES = ["crps", "energy", "mse"]


@pytest.fixture(autouse=True)
def _double(float64):
    return


@pytest.mark.parametrize("score", SCORES)
def test_a_dimension_with_infinite_scale_does_not_count(score):
    filter = toy_denkf()
    frames, out = problem(filter)
    scale, kept = torch.tensor([0.5, math.inf, 4.0]), [0, 2]
    by_hand = lambda ensemble, truth, scale, dims: score_by_hand(  # noqa: E731
        score, ensemble[..., dims] / scale[dims], truth[..., dims] / scale[dims]
    )
    steps, observed = stepped(frames), frames["observed"].all(-1)
    expected = by_hand(out["belief", "ensemble"], frames["state"], scale, kept)[steps].mean()
    losses = DEnKFLoss(filter, score=score, state_scale=scale, observation_scale=[math.inf, 3.0])(frames)
    torch.testing.assert_close(losses["loss_state"], expected, **CLOSE)
    units = torch.tensor([math.inf, 3.0])
    expected = by_hand(out["sensor", "ensemble"], frames["target_observation"], units, [1])[observed].mean()
    torch.testing.assert_close(losses["loss_sensor"], expected, **CLOSE)
    alone = SensorLoss(filter, score=score, observation_scale=units)(frames)["loss_sensor"]
    torch.testing.assert_close(alone, expected, **CLOSE)
    # What does not count may hold anything, and an angle keeps its place.
    frames["state"][..., 1] = math.inf
    again = DEnKFLoss(filter, score=score, **ONLY_STATE, state_scale=scale, space=Flat(3, circular=[1]))(frames)[
        "loss_state"
    ]
    assert again.equal(losses["loss_state"])
    again.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in filter.parameters())
    one_step = TransitionLoss(filter, score=score, state_scale=scale)
    frames["state"][..., 1] = 0.0
    first = one_step(frames)["loss_transition"]
    frames["state"][:, -1, 1] = 5.0  # where no step begins
    assert one_step(frames)["loss_transition"].equal(first)


def test_a_loaded_scale_counts_other_dimensions():
    filter = toy_denkf()
    frames, _ = problem(filter)
    first = DEnKFLoss(filter, **ONLY_STATE, state_scale=[1.0, math.inf, 2.0])
    second = DEnKFLoss(filter, **ONLY_STATE, state_scale=[1.0, 1.0, 1.0])
    assert not second(frames)["loss_state"].equal(first(frames)["loss_state"])
    second.load_state_dict(first.state_dict())
    assert second(frames)["loss_state"].equal(first(frames)["loss_state"])
