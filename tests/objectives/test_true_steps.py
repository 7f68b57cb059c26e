"""Inputs of the transition in steps from the true state; oracle: a transition that repeats its input."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.filters import Filter
from torch_denkf.modules import Initial, SubModel
from torch_denkf.objectives.parts import forecasts_from_truth

NAMES = ("ensemble", "log_weight", "mean", "var", "bias")
E, S = 4000, 2


@pytest.fixture(autouse=True)
def _double(float64):
    torch.manual_seed(0)


class Repeats(SubModel):
    """Copies its inputs to another prefix."""

    def __init__(self, source, target):
        super().__init__(nn.Identity(), [(source, name) for name in NAMES], [(target, name) for name in NAMES])

    def compute(self, *values):
        return values


class Start(Initial):
    """Initial belief of zeros, whose bias is the given mean plus one."""

    ensemble_size, state_dim = E, S

    def __init__(self):
        super().__init__(nn.Identity(), [], [("belief", name) for name in NAMES], optional_keys=[("belief", "mean")])

    def compute(self, mean=None, *, batch_size):
        zero = torch.zeros(*batch_size, S)
        bias = zero + 1.0 if mean is None else mean + 1.0
        ensemble = zero.unsqueeze(-2).expand(*batch_size, E, S)
        return ensemble, ensemble[..., 0], zero, zero, bias


@pytest.mark.parametrize("stored", [False, True])
def test_true_step_starts_from_the_previous_true_state(stored):
    filter = Filter(
        {"transition": Repeats("belief", "forecast"), "end": Repeats("forecast", "belief")}, initial=Start()
    )
    truth, spread = torch.randn(3, 6, S), torch.tensor([0.5, 2.0])
    data = TensorDict({"state": truth, ("belief", "mean"): torch.full((3, 6, S), 7.0)}, [3, 6])
    if stored:
        data["belief", "bias"] = torch.randn(3, 6, S)
    out = forecasts_from_truth(filter, data, truth, "belief", spread=spread, members=E)
    earlier = [0, 0, 1, 2, 3, 4]
    before = truth[:, earlier]
    assert set(out) == {("belief", name) for name in NAMES}
    assert out["belief", "mean"].equal(before)
    torch.testing.assert_close(out["belief", "var"], torch.tensor([0.25, 4.0]).expand(3, 6, S))
    torch.testing.assert_close(out["belief", "log_weight"], torch.full((3, 6, E), -math.log(E)))
    assert out["belief", "bias"].equal(data["belief", "bias"][:, earlier] if stored else torch.ones(3, 6, S))
    # 5 standard errors of 4000 members.
    torch.testing.assert_close(
        out["belief", "ensemble"].std(-2), spread.expand(3, 6, S), rtol=5 / (2 * E) ** 0.5, atol=0
    )
    assert ((out["belief", "ensemble"].mean(-2) - before).abs() < 5 * spread / E**0.5).all()
