"""Oracles: gymnasium's equations written out with angles, energy, and torchrl's own pendulum."""

import math

import pytest
import torch

from torch_denkf.envs import NoisyPendulumEnv


def test_motion_and_reward_are_those_of_gymnasium():
    env = NoisyPendulumEnv(batch_size=[16])
    torch.manual_seed(0)
    rollout = env.rollout(200)
    states, torques, rewards = rollout["state"], rollout["action"], rollout["next", "reward"]
    for row in range(16):
        th, thdot = math.atan2(states[row, 0, 1], states[row, 0, 0]), states[row, 0, 2].item()
        for step in range(20):
            u = torques[row, step].item()
            costs = ((th + math.pi) % (2 * math.pi) - math.pi) ** 2 + 0.1 * thdot**2 + 0.001 * u**2
            assert rewards[row, step].item() == pytest.approx(-costs, abs=2e-3)
            thdot = min(max(thdot + (3 * 10.0 / (2 * 1.0) * math.sin(th) + 3.0 / (1.0 * 1.0**2) * u) * 0.05, -8), 8)
            th = th + thdot * 0.05
            expected = torch.tensor([math.cos(th), math.sin(th), thdot])
            torch.testing.assert_close(rollout["next", "state"][row, step], expected, atol=1e-3, rtol=1e-3)
    assert bool(rollout["next", "truncated"][:, -1].all())
    assert not rollout["next", "done"][:, :-1].any()


def test_readings_are_noisy_and_missing():
    env = NoisyPendulumEnv(0.2, missing=0.3, batch_size=[500])
    rollout = env.rollout(50)
    errors = (rollout["observation"] - rollout["state"][..., :2])[rollout["observed"].squeeze(-1)]
    count = errors.numel()
    assert abs(errors.std().item() / 0.2 - 1) < 5 / (2 * count) ** 0.5
    share = rollout["observed"].float().mean().item()
    assert abs(share - 0.7) < 5 * (0.21 / (500 * 50)) ** 0.5
    assert bool(rollout["observation"][~rollout["observed"].squeeze(-1)].isnan().all())


def test_torque_is_clamped():
    env = NoisyPendulumEnv(batch_size=[4])
    start = env.reset()
    large, most = (env.step(start.clone().set("action", torch.full((4, 1), u)))["next"] for u in (9.0, 2.0))
    torch.testing.assert_close(large["state"], most["state"])
    torch.testing.assert_close(large["reward"], most["reward"])
