"""Gates and lags in either order: what the gate rejects corrects neither the belief nor the lag window."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_denkf, linear_system
from tests.fusion.test_fused import fused
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import GaussianPrior, LearnedTransition, LinearObservation, LinearTransition, MomentPrior
from torch_denkf.monitoring import Gated, GatedAnalysis
from torch_denkf.monitoring.gate import GateOptions
from torch_denkf.smoothers import EnKS, FixedLag

WRONG = (7, 8, 13)


def readings(steps=20):
    torch.manual_seed(0)
    frames = TensorDict({"observation": torch.randn(2, steps, 2)}, [2, steps])
    frames["observed"] = torch.ones(2, steps, 1, dtype=torch.bool)
    return frames


def off(frames, key="observation"):
    frames = frames.copy()
    frames[key] = frames[key].clone()
    frames[key][:, WRONG] += 200.0
    return frames


def hidden(frames, out, key="observed", gate="gate"):
    """Returns the recordings without the readings that the gate rejected, also good ones after a fault."""
    rejected = out[gate, "factor"].isinf()
    assert rejected[:, WRONG].all()
    assert rejected.sum() <= 4 * len(frames) * len(WRONG)
    return frames.copy().set(key, frames[key] & ~rejected)


GATE = {"response": "reject", "window": 1, "rate": 1e-6}
ORDERS = {
    "gate inside": lambda filter: FixedLag(Gated(filter, 2, **GATE), 4),
    "gate outside": lambda filter: Gated(FixedLag(filter, 4), 2, **GATE),
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("scheme", ["etkf", "sakov"])
def test_rejected_equals_missing(float64, order, scheme):
    out = ORDERS[order](linear_denkf(scheme)).sequence(off(readings()))
    expected = FixedLag(linear_denkf(scheme), 4).sequence(hidden(readings(), out))
    for key in (("belief", "ensemble"), ("belief", "past"), ("smoothed", "ensemble")):
        assert_close(out[key], expected[key], rtol=1e-12, atol=1e-12)


def test_down_weighted_reading_corrects_clones_less(float64):
    """Student's t enlarges R: the lag window moves as with that R from the beginning."""
    frames = off(readings())
    gated = ORDERS["gate outside"](linear_denkf()).gates[0]
    gated.response, gated.limits = "student", gated.limits / 1e3
    one = frames[:, 7].copy()
    torch.manual_seed(1)
    members = torch.randn(2, 6, 2)
    one["forecast"] = TensorDict({"ensemble": members, "observation": members, "past": torch.randn(2, 6, 4, 2)}, [2])
    one["sensor"] = {"noise": torch.full((2, 2), 0.5)}
    for key, value in zip(gated.state_keys, gated.initial_state([2]), strict=True):
        one[key] = value
    inside = gated.module.module
    one[inside.in_keys[3]] = one["sensor", "noise"]
    out = gated(one.copy())
    assert (out["gate", "factor"] > 2).all()
    one[inside.in_keys[3]] = one["sensor", "noise"] * out["gate", "factor"]
    expected = gated.module(one.copy())
    for key in (("belief", "ensemble"), ("forecast", "past")):
        assert_close(out[key], expected[key], rtol=1e-12, atol=1e-12)


def late(ensemble_size=8):
    F, _, H, R = linear_system()
    moves = torch.nn.Linear(2, 2, bias=False)
    moves.weight.data = F
    sensors = {"late": FusedSensor(LinearObservation(H), R.sqrt(), delay=3)}
    initial = GaussianPrior(torch.zeros(2), torch.ones(2), ensemble_size=ensemble_size)
    return FusedFilter(LearnedTransition(moves, residual=False), sensors, initial=initial, process_noise=[0.3, 0.3])


def test_a_gate_of_late_readings_is_as_good_as_a_mask(float64):
    frames = TensorDict({"late": readings()["observation"]}, [2, 20])
    frames["late_observed"] = readings()["observed"]
    frames = late().draw_noise(frames, generator=torch.Generator().manual_seed(0))
    gated = Gated(late(), **{**GATE, "rate": 1e-9})
    torch.manual_seed(2)  # of the initial ensemble
    out = gated.sequence(off(frames, "late"))
    torch.manual_seed(2)
    expected = late().sequence(hidden(frames, out, "late_observed"))
    for key in (("belief", "ensemble"), ("smoothed", "ensemble")):
        assert_close(out[key], expected[key], rtol=1e-12, atol=1e-12)


def test_lag_keeps_the_calibration_of_a_gate(float64):
    clean = TensorDict({"observation": torch.randn(4, 200, 2)}, [4, 200])
    options = {"response": "huber", "window": 2, "rate": 2e-3, "freedom": 5.0, "patience": 7, "by_component": True}
    options |= {"adapt_noise": 0.01, "adapt_inflation": 0.02, "gate_prefix": "door"}
    assert set(options) == set(GateOptions.__annotations__)
    gated = Gated(linear_denkf(), 2, **options).calibrate([clean], margin=1.5)
    inside = next(module for module in FixedLag(gated, 3).modules() if isinstance(module, GatedAnalysis))
    assert torch.equal(inside.tables, gated.gates[0].tables)
    assert (inside.slack > 1).all()
    assert torch.equal(inside.slack, gated.gates[0].slack)
    assert {name: getattr(inside, name) for name in options} == options


def test_smoother_excludes_rejected_readings(float64):
    gated = Gated(linear_denkf(), 2, **GATE)
    smoothed, out = EnKS(gated, lag=4)(off(readings())), gated.sequence(off(readings()))
    expected = EnKS(linear_denkf(), lag=4)(hidden(readings(), out))
    assert_close(smoothed["smoothed", "mean"], expected["smoothed", "mean"], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("delay", [0, 3])
def test_a_gate_opens_to_readings_of_an_ensemble_as_to_those_of_a_kalman_filter(float64, delay):
    """Without noise the motion leaves members the covariance of a Kalman filter, that of earlier states included."""
    F, _, H, R = linear_system()
    members = torch.randn(9, 2)
    sensors = {"late": FusedSensor(LinearObservation(H), R.sqrt(), delay=delay)}
    prior = MomentPrior(members.mean(0), members.mT.cov())
    filters = {
        "ensemble": FusedFilter(NoisyLinear(F), sensors, initial=FixedEnsemble(members), lag=3),
        "Kalman": FusedFilter(LinearTransition(F, torch.zeros(2, 2)), sensors, initial=prior, lag=3),
    }
    frames = TensorDict({"late": 0.3 * torch.randn(2, 24, 2)}, [2, 24])
    frames["late"][:, 8:] += 30.0  # the state is elsewhere, which the filter holds for impossible
    options = {"response": "reject", "window": 1, "patience": 4}
    out = {name: Gated(filter, **options).sequence(frames.copy()) for name, filter in filters.items()}
    for key in (("belief", "mean"), ("belief", "var"), ("smoothed", "mean"), ("smoothed", "var"), ("gate", "factor")):
        assert_close(out["ensemble"][key], out["Kalman"][key], rtol=1e-8, atol=1e-8)
    shut = out["Kalman"]["gate", "shut"]
    assert (shut.amax(1) == 4).all()
    assert (shut.diff(dim=1) == -4).any(1).all(), "it opens"


@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_adapted_spread_with_observed_clones_raises(float64, kind):
    """It is inflation; around a filter without a lag window it is that of readings in their order."""
    with pytest.raises(ValueError, match="Refiltering"):
        Gated(fused(kind, delay=3, members=torch.randn(7, 2)), adapt_inflation=0.1)
    if kind == "Kalman":
        with pytest.raises(ValueError, match="FixedLag"):
            Gated(fused(kind, lag=3), adapt_inflation=0.1)
    else:
        Gated(fused(kind, lag=3, members=torch.randn(7, 2)), adapt_inflation=0.1)
    Gated(fused(kind, delay=3, members=torch.randn(7, 2)), adapt_noise=0.1)
