"""Weights between sensors: constant ones are other noise; learned ones fall where a sensor is bad."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.testing import assert_close

from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_system
from tests.filters.gaussian_for_tests import directional_check
from torch_denkf.functional.manifolds import Circle
from torch_denkf.fusion import FusedFilter, FusedSensor, SensorAttention
from torch_denkf.modules import LearnedObservation, LinearObservation, LinearTransition, MomentPrior, Select, SubModel
from torch_denkf.smoothers import FixedLag


class Constant(nn.Module):
    """Sets the same weights everywhere; keeps what it was given."""

    def __init__(self, *weights):
        super().__init__()
        self.weights = weights

    def forward(self, innovations, observed, features):
        self.given = innovations, observed, features
        return torch.tensor(self.weights).expand(observed.shape)


def make(kind, *, weights=None, scale=(1.0, 1.0), joint=False, delay=0, noisy=False):
    F, Q, H, R = linear_system()
    sensors = {
        "first": FusedSensor(LinearObservation(H[:1]), R[:1].sqrt() * scale[0]),
        "second": FusedSensor(LinearObservation(H[1:]), R[1:].sqrt() * scale[1], delay=delay),
    }
    if kind == "Kalman":
        motion, initial = LinearTransition(F, Q), MomentPrior(torch.zeros(2), torch.eye(2))
    else:
        members = torch.randn(7, 2, generator=torch.Generator().manual_seed(0))
        motion, initial = NoisyLinear(F, torch.linalg.cholesky(Q) if noisy else None), FixedEnsemble(members)
    return FusedFilter(motion, sensors, initial=initial, joint=joint, weights=weights)


def frames():
    torch.manual_seed(1)
    td = TensorDict({"first": torch.randn(3, 8, 1), "second": torch.randn(3, 8, 1)}, [3, 8])
    td["first_observed"] = torch.rand(3, 8, 1) < 0.7
    td["first"] = torch.where(td["first_observed"], td["first"], torch.nan)
    return td


@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_a_weight_of_a_quarter_is_twice_the_standard_deviation(float64, kind, joint, delay):
    weighted = make(kind, weights=Constant(0.25, 1.0), joint=joint, delay=delay).sequence(frames())
    noisier = make(kind, scale=(2.0, 1.0), joint=joint, delay=delay).sequence(frames())
    for key in (("belief", "mean"), ("belief", "var"), ("info", "log_likelihood")):
        assert_close(weighted[key], noisier[key], rtol=0, atol=1e-10)
    assert (weighted["weight", "first"][:, 1:] == 0.25).all()


def test_the_network_sees_innovations_in_standard_deviations(float64):
    F, Q, H, R = linear_system()
    network = Constant(1.0, 1.0)
    filter = make("Kalman", weights=network)
    rows = frames()
    rows["first_observed"][:] = True
    rows["first"] = rows["first"].nan_to_num()
    rows["second_observed"] = torch.tensor([True] * 7 + [False]).reshape(1, 8, 1).expand(3, 8, 1)
    out = filter.sequence(rows)
    cov = F @ out["belief", "cov"][:, -2] @ F.mT + Q
    spread = (H[:1] @ cov @ H[:1].mT).squeeze(-1) + R[:1]
    mean = out["belief", "mean"][:, -2] @ F.mT
    innovations, observed, _ = network.given
    assert_close(innovations["first"], (rows["first"][:, -1] - mean @ H[:1].mT) / spread.sqrt(), rtol=0, atol=1e-9)
    assert (innovations["second"] == 0).all()
    assert observed.tolist() == [[True, False]] * 3


class Folded(nn.Module):
    """An angle between -pi and pi."""

    def forward(self, angle):
        return torch.atan2(angle.sin(), angle.cos())


class Given(SubModel):
    """A sensor that draws what stands in the data."""

    def __init__(self, key):
        super().__init__(nn.Identity(), [key], [("sensor", "ensemble")])

    def compute(self, samples):
        return samples


@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
@pytest.mark.parametrize("samples", [False, True])
def test_an_innovation_of_angles_is_the_shorter_way_round(float64, kind, samples):
    """The members lie on both sides of pi, with a mean of 3.1; the reading, -3.0, is 0.183 further round."""
    members = 0.2 * torch.randn(9, 1)
    members = members - members.mean() + 3.1
    assert (members.max(), members.min()) > (torch.pi, 0)
    network, one = Constant(1.0), torch.eye(1)
    sensor = Given("compass") if samples else None  # one that draws samples, or the reading itself
    compass = {"compass": FusedSensor(LearnedObservation(Folded()), [0.3], sensor=sensor, reading_space=Circle())}
    if kind == "Kalman":
        motion, initial = LinearTransition(one, 0 * one), MomentPrior(members.mean(0), members.var(0).diag())
    else:
        motion, initial = NoisyLinear(one), FixedEnsemble(members)
    reading = torch.tensor([-3.0])
    if samples:
        reading = Folded()(reading + 0.3 * torch.linspace(-1, 1, 9).unsqueeze(-1))
        assert reading.max() > 3
    filter = FusedFilter(motion, compass, initial=initial, weights=network)
    filter.sequence(TensorDict({"compass": torch.stack([reading] * 2)}, [2]))
    expected = (2 * torch.pi - 6.1) / (members.var() + 0.09).sqrt()
    assert_close(network.given[0]["compass"], expected.expand(1), rtol=0, atol=1e-9)


def test_late_innovation_uses_the_belief_of_its_time(float64):
    F, Q, H, R = linear_system()
    network = Constant(1.0, 1.0)
    rows = frames()
    rows["first_observed"][:] = True
    rows["first"] = rows["first"].nan_to_num()
    rows["second_observed"] = torch.tensor([False] * 7 + [True]).reshape(1, 8, 1).expand(3, 8, 1)
    make("Kalman", weights=network, delay=2).sequence(rows.copy())
    first = {"first": FusedSensor(LinearObservation(H[:1]), R[:1].sqrt())}
    alone = FusedFilter(LinearTransition(F, Q), first, initial=MomentPrior(torch.zeros(2), torch.eye(2)))
    # It arrives at t = 7 and is of t = 5, of which the other sensor's readings up to t = 6 have told.
    before = FixedLag(alone, 1).sequence(rows[:, :7].copy())["smoothed"][:, -1]
    spread = (H[1:] @ before["cov"] @ H[1:].mT).squeeze(-1) + R[1:]
    innovations, observed, _ = network.given
    expected = (rows["second"][:, -1] - before["mean"] @ H[1:].mT) / spread.sqrt()
    assert_close(innovations["second"], expected, rtol=0, atol=1e-9)
    assert observed.all()


def test_missing_readings_are_ignored_and_weights_have_a_floor(float64):
    torch.manual_seed(0)
    attention = SensorAttention({"a": 2, "b": 1}, features={"b": 3}, floor=0.1)
    values = {"a": torch.randn(5, 2), "b": torch.randn(5, 1)}
    both, alone = torch.ones(5, 2, dtype=torch.bool), torch.tensor([[True, False]] * 5)
    assert_close(attention(values, both, {"b": torch.randn(5, 3)}), torch.full((5, 2), 0.1 + 0.9 / (1 + torch.e**-4)))
    with torch.no_grad():
        for parameter in attention.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    first, second = (attention(values, alone, {"b": torch.randn(5, 3)}) for _ in range(2))
    assert first[:, 0].equal(second[:, 0]), "b is not observed"
    changed = [attention(values, both, {"b": torch.randn(5, 3)}) for _ in range(2)]
    assert not changed[0][:, 0].equal(changed[1][:, 0])
    with torch.no_grad():
        attention.score[-1].bias.fill_(-1e3)
    assert_close(attention(values, both, {"b": torch.zeros(5, 3)}), torch.full((5, 2), 0.1))


def test_with_a_slope_weights_fall_with_the_innovation_before_training(float64):
    attention = SensorAttention({"a": 2, "b": 1}, slope=2.0)
    innovations = {"a": torch.tensor([[3.0, 3.0], [4.0, 0.0]]), "b": torch.tensor([[0.0], [10.0]])}
    odds = torch.exp(torch.tensor(4.0)) / torch.tensor([[10.0, 1.0], [9.0, 101.0]]) ** 2
    expected = 1e-3 + (1 - 1e-3) * odds / (1 + odds)
    assert_close(attention(innovations, torch.ones(2, 2, dtype=torch.bool), {}), expected)
    assert "slope" in attention.state_dict()
    assert "slope" not in SensorAttention({"a": 2, "b": 1}).state_dict()
    with pytest.raises(ValueError, match="slope"):
        SensorAttention({"a": 2}, slope=-1.0)


@pytest.mark.parametrize("slope", [0.0, 2.0])
@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_the_gradient_reaches_the_weights(float64, kind, slope):
    torch.manual_seed(0)
    attention = SensorAttention({"first": 1, "second": 1}, size=4, slope=slope)
    with torch.no_grad():
        for parameter in attention.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    filter = make(kind, weights=attention, delay=2)
    directional_check(
        lambda: sum(filter.sequence(frames())["belief", key].square().sum() for key in ("mean", "var")),
        attention.parameters(),
    )


def test_step_is_sequence_and_compiled_weights_are_eager(float64):
    torch.manual_seed(0)
    attention = SensorAttention({"first": 1, "second": 1}, size=4)
    with torch.no_grad():
        for parameter in attention.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    filter = make("ensemble", weights=attention, delay=2, noisy=True)
    rows = filter.draw_noise(frames())
    expected = filter.sequence(rows.copy())
    row = filter.initialise(rows[:, 0].copy())
    for t in range(1, 8):
        row = filter.step(rows[:, t].copy().update(row.select(*filter.carry_keys)))
    assert_close(row["belief", "ensemble"], expected["belief", "ensemble"][:, -1], rtol=0, atol=1e-12)
    assert_close(row["weight"], expected["weight"][:, -1], rtol=0, atol=1e-12)
    given = {name: torch.randn(3, 1) for name in ("first", "second")}, torch.rand(3, 2) < 0.5, {}
    compiled = torch.compile(attention, backend="eager", fullgraph=True)
    assert_close(compiled(*given), attention(*given), rtol=0, atol=1e-10)


def test_a_long_lag_in_single_precision():
    """The last sixteen states of a stiff filter are as good as one: their covariance together is singular."""
    move, push = torch.tensor([[1.0, 0.02], [0.0, 1.0]]), torch.diag(torch.tensor([0.0, 0.02]))
    sensors = {"wheel": FusedSensor(Select([1]), [0.3]), "gps": FusedSensor(Select([0]), [0.5], delay=15)}
    initial, weights = MomentPrior(torch.zeros(2), 0.1 * torch.eye(2)), SensorAttention({"wheel": 1, "gps": 1})
    filter = FusedFilter(LinearTransition(move, push), sensors, initial=initial, weights=weights)
    out = filter.sequence(TensorDict({"wheel": torch.randn(3, 40, 1), "gps": torch.randn(3, 40, 1)}, [3, 40]))
    assert out["belief", "mean"].isfinite().all()
    out["belief", "mean"].square().sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in weights.parameters() if parameter.grad is not None)
