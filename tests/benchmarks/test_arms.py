"""Oracles: MuJoCo's own positions of finger, hand and target, and readings held by hand."""

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("dm_control", reason="dm_control is not installed: pip install dm-control 'mujoco<4'")

from benchmarks.arms.arms import ARMS, NOISE, Encoders, HoldReading, make_env, make_one, wrap


def physics_at(name, seed):
    """An arm after a reset, what it emits as float32, and its simulator."""
    env = make_one(ARMS[name], pixels=False)
    env.set_seed(seed)
    emitted = env.reset().float()
    return ARMS[name], emitted, env._env.physics


@pytest.mark.parametrize("seed", range(4))
def test_reacher_knows_where_finger_and_target_are(seed):
    arm, emitted, physics = physics_at("reacher", seed)
    angles, velocity = arm.split(arm.state(emitted))
    at = {name: torch.tensor(physics.named.data.geom_xpos[name, :2]).float() for name in ("finger", "target")}
    torch.testing.assert_close(arm.tip(angles), at["finger"], atol=1e-6, rtol=0)
    goal = arm.goal(emitted)
    torch.testing.assert_close(arm.tip(goal), at["target"], atol=1e-3, rtol=0)  # the wrist's stop apart
    assert goal[1].abs() < 2.8  # rad; the stop is at 2.79
    torch.testing.assert_close(velocity, torch.tensor(physics.data.qvel[:2]).float())


@pytest.mark.parametrize("seed", range(3))
def test_manipulator_knows_where_its_hand_is(seed):
    arm, emitted, physics = physics_at("manipulator", seed)
    angles, _ = arm.split(arm.state(emitted))
    hand = torch.tensor(physics.named.data.site_xpos["pinch", ["x", "z"]]).float() - torch.tensor([0.0, 0.4])
    up, aside = arm.tip(angles)
    torch.testing.assert_close(torch.stack([-aside, up]), hand, atol=1e-6, rtol=0)
    assert not arm.goal(emitted).equal(arm.goal(emitted))  # another pose each time


@pytest.mark.parametrize("name", sorted(ARMS))
def test_the_controller_reaches_the_goal_on_the_truth(name):
    from tensordict.nn import TensorDictModule

    arm = ARMS[name]
    env = make_env(arm, False, 1)
    env.set_seed(0)
    policy = TensorDictModule(arm.control, in_keys=["state", "goal"], out_keys=["action"])
    with torch.no_grad():
        end = env.rollout(150, policy, break_when_any_done=False)[0, -1]
    distance = (arm.tip(arm.split(end["next", "state"])[0]) - arm.tip(end["goal"])).norm()
    assert distance < 0.04  # m; without integral action gravity leaves the manipulator a little below
    env.close()


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


def test_held_readings():
    arm = ARMS["reacher"]
    hold = HoldReading(arm, "reading")

    def frame(angle, seen=True):
        angle = torch.tensor([angle, 0.0])
        return TensorDict({"reading": torch.cat([angle.cos(), angle.sin()]), "observed": torch.tensor([seen])}, [])

    held = hold._reset(None, frame(3.1))
    velocities = []
    for angle, seen in ((3.1, True), (-3.1, True), (1.0, False), (-3.0, True)):
        held = hold._step(held, frame(angle, seen))
        angles, velocity = arm.split(held["held"])
        velocities.append(velocity[0].item())
    assert angles[0].item() == pytest.approx(-3.0)
    step = (2 * torch.pi - 6.2) / arm.dt  # from 3.1 on to -3.1, not all the way back
    expected = [0.0, 0.2 * step, 0.16 * step, 0.128 * step + 0.2 * 0.1 / arm.dt]
    assert velocities == pytest.approx(expected, rel=1e-4)
