"""Infinite scales, filters without a sensor, one member. Oracles: the loss without those dimensions, by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import NoisyLinear, toy_denkf
from tests.objectives.denkf_for_tests import CLOSE, ONLY_STATE, score_by_hand
from tests.objectives.problem_for_tests import problem, stepped
from torch_denkf.filters import Filter
from torch_denkf.functional.manifolds import Flat
from torch_denkf.modules import Initial, SubModel
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


# --------------------------------------------------------------------------------------------------- one member


class Point(Initial):
    """An initial belief of one member; it has no variance."""

    def __init__(self):
        super().__init__(nn.Identity(), [], [("belief", "ensemble")])
        self.ensemble_size = 1

    def compute(self, *, batch_size):
        return torch.ones(*batch_size, 1, 2)


class Believe(SubModel):
    """The belief is the forecast."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("belief", "ensemble")])

    def compute(self, ensemble):
        return ensemble.clone()


@pytest.mark.parametrize("score", SCORES)
def test_one_member_is_a_point(score):
    move = NoisyLinear(torch.tensor([[0.5, 1.0], [0.0, 0.9]]))
    move.matrix.requires_grad_()
    filter = Filter(move, Believe(), initial=Point())
    frames = TensorDict({"state": torch.randn(2, 5, 2), "is_init": torch.zeros(2, 5, 1, dtype=torch.bool)}, [2, 5])
    member = filter.sequence(frames.copy())["belief", "ensemble"].squeeze(-2)
    scale = torch.tensor([2.0, 0.5])
    error = ((member - frames["state"]) / scale)[:, 1:]
    expected = {"crps": error.abs().mean(), "mse": error.square().mean()}
    expected["energy"] = error.square().sum(-1).sqrt().mean()
    value = DEnKFLoss(filter, score=score, state_scale=scale)(frames)["loss_state"]
    torch.testing.assert_close(value, expected[score], **CLOSE)
    (gradient,) = torch.autograd.grad(value, move.matrix, retain_graph=True)
    (by_hand,) = torch.autograd.grad(expected[score], move.matrix)
    torch.testing.assert_close(gradient, by_hand)
    step = TransitionLoss(filter, score="crps")(frames)["loss_transition"]
    moved = frames["state"][:, :-1] @ move.matrix.mT - frames["state"][:, 1:]
    torch.testing.assert_close(step, moved.abs().mean(), **CLOSE)
