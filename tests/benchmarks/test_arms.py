"""Oracles: MuJoCo's own positions, weights and cameras, closed forms of the noises, and readings held by hand."""

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("dm_control", reason="dm_control is not installed: pip install dm-control 'mujoco<4'")

from benchmarks.arms.arms import ARMS, NOISE, Encoders, make_one, wrap
from benchmarks.arms.filters import DRIFT, LENGTH, ArmTransition
from benchmarks.arms.sensor import FromPlaces, JointPlaces


def physics_at(name, seed):
    """Returns an arm after a reset, what it emits as float32, and its simulator."""
    env = make_one(ARMS[name], pixels=False)
    env.set_seed(seed)
    emitted = env.reset().float()
    return ARMS[name], emitted, env._env.physics


@pytest.mark.parametrize("seed", range(4))
def test_reacher_positions_of_finger_and_target(seed):
    arm, emitted, physics = physics_at("reacher", seed)
    angles, velocity = arm.split(arm.state(emitted))
    at = {name: torch.tensor(physics.named.data.geom_xpos[name, :2]).float() for name in ("finger", "target")}
    torch.testing.assert_close(arm.tip(angles), at["finger"], atol=1e-6, rtol=0)
    goal = arm.goal(emitted)
    torch.testing.assert_close(arm.tip(goal), at["target"], atol=1e-3, rtol=0)  # the wrist's stop apart
    assert goal[1].abs() < 2.8  # rad; the stop is at 2.79
    torch.testing.assert_close(velocity, torch.tensor(physics.data.qvel[:2]).float())


def test_readings_have_the_stated_noise_and_are_missing_as_often_as_stated():
    arm = ARMS["reacher"]
    emitted = TensorDict({"position": torch.full((20000, 2), 3.0), "velocity": torch.ones(20000, 2)}, [20000])
    before = TensorDict({"goal": torch.zeros(20000, 2)}, [20000])
    out = Encoders(arm, 0.3)._step(before, emitted)
    angles = torch.atan2(out["reading"][:, 2:], out["reading"][:, :2])
    error = wrap(angles - 3.0)
    assert abs(error.std() - NOISE) < 0.002  # its own deviation is 0.0004
    assert abs(out["observed"].float().mean() - 0.7) < 0.02
    assert out["state"][0].tolist() == pytest.approx([-0.98999, -0.98999, 0.14112, 0.14112, 1.0, 1.0], abs=1e-4)


def transition(arm, bias=None):
    torch.manual_seed(0)
    one = torch.ones(arm.joints)
    return ArmTransition(arm, one, 50 * one, one, one, bias)


def test_the_forecast_turns_by_the_new_velocity():
    arm = ARMS["reacher"]
    move = transition(arm)
    state = arm.join(torch.tensor([0.3, -0.5]), torch.tensor([1.0, 2.0])).expand(4000, -1)
    action = torch.tensor([0.2, -0.1])
    with torch.no_grad():
        mean, std = move.faster(state[0], action)
        angles, velocity = arm.split(move.compute(state, action))
    assert torch.allclose((velocity - torch.tensor([1.0, 2.0])).mean(0), mean, atol=float(5 * std.max() / 4000**0.5))
    turned = angles - torch.tensor([0.3, -0.5]) - arm.dt * velocity
    drift = [(DRIFT**2 * arm.dt * speed + arm.creep**2) ** 0.5 for speed in (1, 2)]
    assert turned.std(0).tolist() == pytest.approx(drift, rel=0.06)  # the drift alone


def test_biases_fade_with_the_way_and_not_with_time():
    arm = ARMS["reacher"]
    move = transition(arm, torch.full((4,), 0.1))
    moving = arm.join(torch.zeros(2), torch.tensor([3.0, 4.0]))  # 5 rad/s
    resting = arm.join(torch.zeros(2), torch.zeros(2))
    bias = 0.1 * torch.randn(20000, 4)
    for state, way in ((moving, 0.02 * 5), (resting, 0.02 * 1e-4)):
        with torch.no_grad():
            later = move.compute(torch.cat([state.expand(20000, -1), bias], -1), torch.zeros(2))[:, 6:]
        kept = (later * bias).mean(0) / bias.square().mean(0)
        assert kept.tolist() == pytest.approx([2.718281828 ** (-way / LENGTH)] * 4, abs=0.02)
        assert later.std(0).tolist() == pytest.approx([0.1] * 4, rel=0.03)


def test_the_first_belief_shares_a_reading_between_places_and_biases():
    arm = ARMS["reacher"]
    mean, std, bias = torch.zeros(6), torch.tensor([1.0, 1.0, 1.0, 1.0, 0.1, 0.2]), torch.full((4,), 0.003)
    start = FromPlaces(arm, mean=mean, std=std, bias=bias, ensemble_size=20000)
    angles = torch.tensor([0.3, 0.5])
    reading = arm.places(angles).flatten(-2)
    belief = start(TensorDict({"sensor": {"reading": reading, "noise": torch.full((4,), 0.004**2)}}))
    ensemble = belief["belief", "ensemble"]
    found, velocity = arm.split(ensemble)
    assert found.mean(0).tolist() == pytest.approx(angles.tolist(), abs=0.003)
    assert velocity.std(0).tolist() == pytest.approx([0.1, 0.2], rel=0.03)
    # Of the first link's direction: noise and bias across it, over its length.
    assert found[:, 0].std().item() == pytest.approx(0.005 / 0.12, rel=0.03)
    # What is read is place plus bias; the first place is on a circle, though, and so is compared across the link.
    spread = (JointPlaces(arm).compute(ensemble) - reading)[:, :2] @ torch.tensor([-angles[0].sin(), angles[0].cos()])
    assert spread.std().item() == pytest.approx(0.004, rel=0.03)  # the biases are taken away again
