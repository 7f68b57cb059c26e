"""Oracles: the simulator's own data, the law of the expert's plan, and that a seed is an episode."""

from functools import partial

import numpy as np
import pytest
import torch
from torchrl.envs import ParallelEnv, SerialEnv, check_env_specs

from tests.envs.opengl import needs_opengl
from torch_denkf.applications.ur5 import UR5TableEnv
from torch_denkf.applications.ur5.envs.expert import UR5Expert

pytest.importorskip("mujoco", reason="mujoco is not installed: pip install 'mujoco>=3.17,<4'")


TASKS = ("pick", "push", "put_down")


def blind(task="pick", domain="sim", **kwargs):
    return UR5TableEnv(task, domain, from_pixels=False, **kwargs)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_expert_succeeds_and_the_judge_is_right(task, seed):
    env = blind(task, seed=seed)
    rollout = env.rollout(400, UR5Expert(env))
    assert rollout.shape == (350,)
    done = rollout["next", "success"].squeeze(-1)
    assert done[-1]
    assert not rollout["success"][0]
    torch.testing.assert_close(rollout["next", "reward"].squeeze(-1), done.float())
    # The same judgement from what the environment emits, with the thresholds of its documentation.
    thing, goal = rollout["next", "expert", "object"], rollout["next", "expert", "goal"]
    height = env._episode.half_size[2]
    if task == "pick":
        clear = thing[:, 2] - height
        assert done[clear > 0.081].all()
        assert not done[clear < 0.079].any()
        hand = rollout["next", "state"][done, 7:]
        assert (hand - thing[done]).norm(dim=-1).max() < 0.03  # it hangs in the gripper
    else:
        away = (thing - goal)[:, :2].norm(dim=-1)
        assert not done[away > 0.031].any()
        assert away[-1] < 0.03
        assert thing[-1, 2].item() == pytest.approx(height, abs=0.002)  # it stands on the table
    if task == "push":
        assert thing[:, 2].max() < height + 0.01  # it was not carried
    if task == "put_down":
        assert thing[0, 2] > height + 0.05
        assert (rollout["next", "state"][-1, 7:] - thing[-1]).norm() > 0.07


def test_state_is_the_simulators():
    env = blind(seed=1)
    state = env.rollout(120, UR5Expert())["next", "state"][-1].numpy()
    data = env._scene.data
    joints = [
        data.joint(n).qpos[0] for n in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    ]
    np.testing.assert_allclose(state[:6], joints, atol=1e-6)
    # The finger tips are 2 x 42.5 mm apart at 0.8 rad; the pads' faces lie at the fingers' origins.
    gap = data.body("finger_left").xpos - data.body("finger_right").xpos
    np.testing.assert_allclose(np.linalg.norm(gap), state[6] / 0.8 * 0.085, atol=2e-6)
    np.testing.assert_allclose(state[7:], data.site("pinch").xpos - data.site("table_centre").xpos, atol=1e-6)


def test_arm_reaches_its_target():
    env = blind(seed=2)
    rollout = env.rollout(350, UR5Expert(env))
    action, state = rollout["action"], rollout["next", "state"]
    torch.testing.assert_close(action, rollout["expert", "action"])
    # Servos lag a moving target by less than two degrees, and stand within a fifth of one at the end.
    assert (action - state[:, :7])[:, :6].abs().max() < 0.035
    assert (action - state[:, :7])[-1, :6].abs().max() < 0.0035
    assert state[:, 6].diff().abs().max() < 0.1  # the gripper's ramp
    assert rollout["state"].std(0).min() > 0.01  # nothing is constant


def test_speeds_are_limited():
    env = blind(seed=0)
    td = env.reset()
    start = td["state"][:7].clone()
    far = start + torch.tensor([1.0, 0, 0, 0, 0, 0, -2.0])
    for step in range(1, 4):
        env.step(td.set("action", far))
        sent = torch.from_numpy(env._scene.target).float() - start
        assert sent[0].item() == pytest.approx(min(1.0, step * torch.pi * 0.08), abs=1e-4)
        assert sent[6].item() == pytest.approx(-min(start[6].item(), step * 0.12), abs=1e-4)


def test_joints_of_the_real_like_arm_stand_off():
    runs = {}
    for domain in ("sim", "real_like"):
        env = blind("pick", domain, seed=0)
        runs[domain] = env.rollout(350, UR5Expert(env))
    assert runs["sim"]["expert", "action"].equal(runs["real_like"]["expert", "action"])  # the same episode
    # At rest: the constant offsets, give or take the 4 N m of dry friction that a servo of 4000 N m/rad leaves.
    rest = (runs["real_like"]["next", "state"][-1] - runs["sim"]["next", "state"][-1])[:6]
    offset = torch.tensor([0.012, -0.008, 0.010, -0.012, 0.010, 0.015])
    torch.testing.assert_close(rest, offset, atol=0.0025, rtol=0)


OPTIONS = {"size": (16, 24), "max_steps": 6}
SEEDS = [{"seed": 3}, {"seed": 4}]


def alone():
    return torch.stack([UR5TableEnv("pick", **OPTIONS, **seed).rollout(6, UR5Expert()) for seed in SEEDS])


@pytest.mark.parametrize("kind", [SerialEnv, pytest.param(ParallelEnv, marks=pytest.mark.slow)])
def test_batched(kind):
    needs_opengl()
    env = kind(2, partial(UR5TableEnv, "pick", **OPTIONS), create_env_kwargs=SEEDS)
    try:
        rollout = env.rollout(6, UR5Expert())
        assert (rollout == alone()).all()
        check_env_specs(env)
        env.set_seed(0)
        start = env.reset()["state"]
        assert (start[0] != start[1]).any()
    finally:
        env.close()
