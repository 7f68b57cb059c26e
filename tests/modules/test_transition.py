"""Oracles: the formula with linear networks, the exact circular arc, finite differences."""

import re

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.gaussian_for_tests import directional_check
from tests.functional.checks import assert_raises
from torch_denkf.applications.car import UnicycleMotion, UnicycleTransition
from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.applications.car.modules.unicycle_pose import UnicyclePose
from torch_denkf.modules import ConstantNoise, LearnedTransition, StochasticMLP

BATCHES = [(), (3,), (2, 3)]


def forecast(transition, ensemble, **entries):
    td = TensorDict({("belief", "ensemble"): ensemble, **entries}, ensemble.shape[:-2])
    return transition(td)["forecast", "ensemble"]


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize("scaled", [True, False])
@pytest.mark.parametrize("action", [True, False])
def test_learned_transition_is_its_formula(float64, batch, residual, scaled, action):
    state, drive = torch.randn(*batch, 5, 3), torch.randn(*batch, 2)
    loc, scale = torch.randn(3), torch.rand(3) + 0.5
    net = nn.Linear(5 if action else 3, 3)
    transition = LearnedTransition(
        net,
        residual=residual,
        loc=loc if scaled else None,
        scale=scale if scaled else None,
        action_key="action" if action else None,
    )
    m, s = (loc, scale) if scaled else (torch.zeros(3), torch.ones(3))
    change = ((state - m) / s) @ net.weight[:, :3].mT + net.bias
    if action:
        change = change + (drive @ net.weight[:, 3:].mT).unsqueeze(-2)
    expected = s * change + (state if residual else m)
    torch.testing.assert_close(forecast(transition, state, action=drive), expected, rtol=0, atol=1e-13)


def test_commands_are_standardised(float64):
    state, drive, net = torch.randn(4, 5, 3), 300 + 90 * torch.randn(4, 2), nn.Linear(5, 3)
    plain = LearnedTransition(net, action_key="action")
    scaled = LearnedTransition(net, action_key="action", action_loc=[300.0, 300.0], action_scale=[90.0, 45.0])
    expected = forecast(plain, state, action=(drive - 300) / torch.tensor([90.0, 45.0]))
    torch.testing.assert_close(forecast(scaled, state, action=drive), expected, rtol=0, atol=1e-13)


def moved(pose, velocity, dt):
    """Returns the vehicle's state after a step with these velocities."""
    (x, y, theta), (v, w) = pose.unbind(-1), velocity.unbind(-1)
    angle = theta + w * dt / 2
    return torch.stack([x + v * dt * angle.cos(), y + v * dt * angle.sin(), theta + w * dt, v, w], -1)


def still(velocity):
    return torch.zeros_like(velocity)


@pytest.mark.parametrize("batch", BATCHES)
def test_unicycle_on_a_circular_arc(float64, batch):
    dt = 0.1
    speed, rate = 5 + 10 * torch.rand(*batch, 20), torch.randn(*batch, 20)
    pose = torch.randn(*batch, 20, 3)
    state = torch.cat([pose, torch.stack([speed, rate], -1)], -1)
    out = forecast(UnicycleTransition(still, dt), state)
    # The arc's endpoint: its chord has length 2 v / w sin(w dt / 2) and direction theta + w dt / 2.
    heading = pose[..., 2] + rate * dt / 2
    chord = 2 * speed / rate * (rate * dt / 2).sin()
    exact = pose[..., :2] + chord.unsqueeze(-1) * torch.stack([heading.cos(), heading.sin()], -1)
    # The model takes v dt for the chord: 1 - sin(a)/a <= a^2 / 6 with a = w dt / 2, so v dt (w dt)^2 / 24 at most,
    # and at least 95 % of that for a < 1 (the next term of the series is a^2 / 20 of it).
    error = (out[..., :2] - exact).norm(dim=-1)
    bound = speed * dt * (rate * dt) ** 2 / 24
    assert (error <= bound + 1e-14).all()
    assert (error >= 0.95 * bound - 1e-14).all()
    torch.testing.assert_close(out[..., 2], pose[..., 2] + rate * dt, rtol=0, atol=1e-15)
    assert out[..., 3:].equal(state[..., 3:])


def test_unicycle_velocity_changes_before_the_pose_moves(float64):
    net = nn.Linear(2, 2)
    loc, scale = torch.tensor([8.0, 0.1]), torch.tensor([3.0, 0.2])
    state = torch.randn(6, 5)
    out = forecast(UnicycleTransition(net, 0.5, loc=loc, scale=scale), state)
    velocity = state[:, 3:] + scale * net((state[:, 3:] - loc) / scale)
    torch.testing.assert_close(out, moved(state[:, :3], velocity, 0.5), rtol=0, atol=1e-13)


def test_unicycle_gradients(float64):
    net = nn.Linear(2, 2)
    transition = UnicycleTransition(net, 0.1, loc=[1.0, 0.1], scale=[2.0, 0.3])
    state = torch.randn(3, 5, requires_grad=True)
    directional_check(lambda: forecast(transition, state).sin().sum(), [state, *net.parameters()])


@pytest.mark.parametrize("batch", BATCHES)
def test_motion_takes_the_velocities_of_the_analysis_and_the_pose_of_the_last_belief(float64, batch):
    before, analysis = torch.randn(*batch, 6, 5), torch.randn(*batch, 6, 5)
    td = TensorDict({"belief": {"ensemble": before}, "analysis": {"ensemble": analysis}}, batch)
    out = UnicycleMotion(0.5)(td)["belief"]
    expected = moved(before[..., :3], analysis[..., 3:], 0.5)
    torch.testing.assert_close(out["ensemble"], expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(out["mean"], expected.mean(-2), rtol=0, atol=1e-14)
    torch.testing.assert_close(out["var"], expected.var(-2), rtol=0, atol=1e-13)


def test_a_transition_without_drift_spreads_the_velocities_and_leaves_their_mean():
    network = StochasticMLP(2, 2)  # untrained: its mean change is anything
    state = torch.randn(3, 16, 5) + torch.tensor([0.0, 0.0, 0.0, 8.0, 0.1])
    outs = {}
    for drift in (True, False):
        torch.manual_seed(1)
        transition = UnicycleTransition(network, dt=0.1, scale=[2.0, 0.1], drift=drift)
        td = TensorDict({("belief", "ensemble"): state}, [3])
        outs[drift] = transition(td)["forecast", "ensemble"][..., 3:] - state[..., 3:]
    torch.testing.assert_close(outs[False].mean(1), torch.zeros(3, 2), rtol=0, atol=1e-6)
    torch.testing.assert_close(outs[False], outs[True] - outs[True].mean(1, keepdim=True), rtol=1e-5, atol=1e-6)
    assert outs[False].std(1).min() > 0.001


# -------------------------------------------------------------------------------------- a time step that varies


def states(**shapes):
    return TensorDict({name: torch.randn(4, 6, *shape) for name, shape in shapes.items()}, [4])


def gaussian(size):
    root = torch.randn(4, size, size)
    return {"mean": torch.randn(4, size), "cov": root @ root.mT}


#: name: (the module for a time step, a number or an entry; what it reads)
MOVING = {
    "transition": (
        lambda dt: UnicycleTransition(nn.Linear(2, 2), dt, scale=[2.0, 0.1]),
        lambda: {"belief": states(ensemble=[5])},
    ),
    "transition with a history": (
        lambda dt: UnicycleTransition(still, dt, history_key=("belief", "history")),
        lambda: {"belief": states(ensemble=[5], history=[2, 2])},
    ),
    "motion": (UnicycleMotion, lambda: {"belief": states(ensemble=[5]), "analysis": states(ensemble=[5])}),
    "noise": (
        lambda dt: UnicycleNoise(ConstantNoise([0.5, 0.1], in_key=("belief", "mean"), out_key=("q", "r")), dt),
        lambda: {"belief": {"mean": torch.randn(4, 5)}, "forecast": {"mean": torch.randn(4, 5)}},
    ),
    "pose": (UnicyclePose, lambda: {"forecast": gaussian(5), "velocity": gaussian(2)}),
}


@pytest.mark.parametrize("name", MOVING)
@pytest.mark.parametrize("key", ["dt", ("clock", "dt")])
def test_dt_may_be_an_entry_that_varies_over_rows(float64, name, key):
    make, entries = MOVING[name]
    td, dts = TensorDict(entries(), [4]), torch.tensor([[0.1], [0.2], [0.0], [1.5]])
    module = make(key)
    assert key in module.in_keys
    out, rows = module(td.copy().set(key, dts)), []
    for dt, row in zip(dts, td, strict=True):
        alone = make(float(dt))
        alone.load_state_dict(module.state_dict())
        rows.append(alone(row.copy()).select(*module.out_keys))
    for entry in module.out_keys:
        torch.testing.assert_close(out[entry], torch.stack(rows)[entry], rtol=0, atol=1e-13)
    words = f"{type(module).__name__} reads {key!r}, which is missing"
    assert_raises(KeyError, re.escape(words), module, td)
