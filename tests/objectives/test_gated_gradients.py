"""Losses of gated filters of several sensors, by finite differences, and packages of their steps."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.differences_for_tests import check_largest_gradients
from torch_denkf.fusion import FusedFilter, FusedSensor, SensorAttention
from torch_denkf.modules import (
    ConstantNoise,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    MomentPrior,
    Select,
    StochasticMLP,
)
from torch_denkf.monitoring import Gated, InnovationMonitor, Monitored, MonitoredSensor
from torch_denkf.objectives import DEnKFLoss, GaussianLoss

STATES = 2
BELIEFS = {
    "ensemble": lambda: GaussianPrior(torch.zeros(STATES), torch.ones(STATES), ensemble_size=6),
    "moments": lambda: MomentPrior(torch.zeros(STATES), torch.eye(STATES)),
}


def fused(belief, delay, **options):
    torch.manual_seed(1)
    smooth = {"layer": "none", "activation": nn.Tanh}
    sensors = {
        "near": FusedSensor(
            LearnedObservation(StochasticMLP(STATES, 1, (6,), **smooth)), ConstantNoise([0.8], in_key="near")
        ),
        "far": FusedSensor(Select([1]), [0.4], delay=delay),
    }
    motion = LearnedTransition(StochasticMLP(STATES, STATES, (6,), **smooth))
    return FusedFilter(motion, sensors, initial=BELIEFS[belief](), process_noise=[0.1] * STATES, **options)


def frames(*batch):
    torch.manual_seed(0)
    out = TensorDict({"state": torch.randn(*batch, STATES)}, batch)
    for name in ("near", "far"):
        out[name] = torch.randn(*batch, 1)
        out[f"{name}_observed"] = torch.rand(*batch, 1) < 0.7
    return out


CASES = {
    "weighed down": lambda belief, delay: Gated(fused(belief, delay), rate=0.1),
    "rejected": lambda belief, delay: Gated(fused(belief, delay), response="reject", rate=1e-3),
    "adapted": lambda belief, delay: Gated(fused(belief, delay), rate=0, adapt_noise=0.2),
    "weights and a joint update": lambda belief, delay: Gated(
        fused(belief, delay, joint=True, weights=SensorAttention({"near": 1, "far": 1})), 2, rate=0.1
    ),
    "watched": lambda belief, delay: Monitored(
        Gated(fused(belief, delay), response="huber", rate=0.1),
        InnovationMonitor({"near": MonitoredSensor("gate_near", 1, "near_observed")}),
    ),
}


@pytest.mark.parametrize("belief", BELIEFS)
@pytest.mark.parametrize("case", CASES)
def test_gradients_by_finite_differences(float64, case, belief):
    filter = CASES[case](belief, 2)
    data = filter.draw_noise(frames(2, 5), generator=torch.Generator().manual_seed(3))
    loss = (DEnKFLoss if belief == "ensemble" else GaussianLoss)(filter, sensor=0.0, nll=1.0)

    def value():
        torch.manual_seed(7)  # of the initial ensemble
        return sum(loss(data.copy()).values())

    value().backward()
    # As many digits as central differences of sums of several hundred leave.
    assert check_largest_gradients([filter], value, rtol=1e-5, atol=1e-6) >= 8
