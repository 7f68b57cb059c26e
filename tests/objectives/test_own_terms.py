"""Custom loss terms: alone and together with a loss's terms, their rows, their parameters, and their errors."""

import pytest
import torch
from torch import nn

from tests.filters.factories import S, linear_kalman, toy_denkf
from tests.objectives.denkf_for_tests import CLOSE
from tests.objectives.problem_for_tests import problem, stepped
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss, Term
from torch_denkf.objectives.filter_loss import FilterLoss


class Absolute(Term):
    """Absolute error of the belief's mean, times a learned factor."""

    name = "absolute"

    def __init__(self, weight=1.0):
        super().__init__(weight)
        self.factor = nn.Parameter(torch.ones(()))

    def forward(self, out, truth):
        mean = out["belief", "mean"]
        labels = truth.state(mean.shape[-1])
        return self.factor * labels.mean(labels.errors(mean).abs()), labels.rows


class OfAllFrames(Absolute):
    name, of_frames = "frames", True


class Size(Term):
    name, needs_state = "size", False

    def forward(self, out, truth):
        return out["belief", "mean"].square().sum(-1), None


class Number(Term):
    name, needs_state = "number", False

    def forward(self, out, truth):
        return torch.tensor(3.0), None


@pytest.fixture(autouse=True)
def _double(float64):
    return


def test_custom_terms_equal_values_by_hand():
    filter = toy_denkf()
    frames, out = problem(filter)
    frames["state_observed"] = torch.rand(2, 7, S) < 0.6
    scale, known, steps = torch.tensor([0.5, 3.0, 4.0]), frames["state_observed"], stepped(frames)
    loss = FilterLoss(filter, [Absolute(2.0), OfAllFrames(), Size(), Number(0.5)], state_scale=scale)
    assert loss.out_keys == ["loss_absolute", "loss_frames", "loss_size", "loss_number"]
    errors = torch.where(known, ((out["belief", "mean"] - frames["state"]) / scale).abs(), 0)
    value, rows = errors.sum(-1) / known.sum(-1).clamp(min=1), known.any(-1)
    losses = loss(frames)
    torch.testing.assert_close(losses["loss_absolute"], 2 * value[rows & steps].mean(), **CLOSE)
    torch.testing.assert_close(losses["loss_frames"], value[rows].mean(), **CLOSE)
    size = out["belief", "mean"].square().sum(-1)
    torch.testing.assert_close(losses["loss_size"], size[steps].mean(), **CLOSE)
    assert losses["loss_number"] == 1.5
    each = FilterLoss(filter, [Size()], reduction="none")(frames)["loss_size"]
    torch.testing.assert_close(each, torch.where(steps, size, 0), **CLOSE)


@pytest.mark.parametrize(("make", "filter"), [(DEnKFLoss, toy_denkf), (GaussianLoss, linear_kalman)])
def test_custom_terms_are_added_to_those_of_a_loss(make, filter):
    filter = filter()
    options = {"sensor": 0.0}
    keys = make(filter, **options).out_keys
    loss = make(filter, **options, terms=[Absolute(), Size(0.0)])
    assert loss.out_keys == [*keys, "loss_absolute"]
    assert MixtureLoss(filter, terms=[Size()]).out_keys == ["loss_state", "loss_size"]
    if make is DEnKFLoss:
        frames, _ = problem(filter)
        both, alone = loss(frames), make(filter, **options)(frames)
        assert all(both[key].equal(alone[key]) for key in keys)


def test_parameters_of_a_term_are_trained():
    filter = toy_denkf()
    frames, _ = problem(filter)
    term = Absolute()
    loss = FilterLoss(filter, [term])
    assert {id(p) for p in loss.parameters()} == {id(term.factor), *(id(p) for p in filter.parameters())}
    loss(frames)["loss_absolute"].backward()
    assert term.factor.grad > 0
    assert any(p.grad is not None and p.grad.any() for p in filter.parameters())


def test_true_state_is_required_only_by_terms_that_need_it():
    filter = toy_denkf()
    frames, _ = problem(filter)
    assert "state" in FilterLoss(filter, [Absolute()]).in_keys
    loss = FilterLoss(filter, [Absolute(0.0), Size()])
    assert "state" not in loss.in_keys
    assert loss(frames.exclude("state"))["loss_size"].isfinite()
    renamed = frames.copy().set(("truth", "x"), frames["state"]).exclude("state")
    loss = FilterLoss(filter, [Absolute()])
    with pytest.raises(KeyError, match=r"FilterLoss reads 'state'.*set_keys"):
        loss(renamed)
    loss.set_keys(state=("truth", "x"))
    assert loss(renamed)["loss_absolute"].equal(FilterLoss(filter, [Absolute()])(frames)["loss_absolute"])
