"""A legged filter estimates the velocity of the simulated humanoid, which walks in a harness."""

import torch

from torch_denkf.applications.legged import legged_filter
from torch_denkf.applications.legged.humanoid import HUMANOID, humanoid_env, stroll


def walking(env, steps, **gait):
    td, rows = env.reset(), []
    for step in range(steps):
        begun = min(1.0, step * env.dt)
        td["action"] = stroll(step * env.dt, stride=0.2 * begun, lift=0.4 * begun, **gait)
        td = env.step(td)["next"]
        rows.append(td.exclude("done", "terminated", "truncated", "reward"))
    return torch.stack(rows)


def test_velocity_error_of_the_humanoid():
    env = humanoid_env(seed=1)
    log = walking(env, 200).unsqueeze(0)
    filter = legged_filter(env.model, **HUMANOID, dt=env.dt, kind="EKF")
    with torch.no_grad():
        out = filter.sequence(log.clone())
    true = log["true", "velocity"][:, 50:]
    error = (out["belief", "velocity"][:, 50:] - true).square().sum(-1).mean().sqrt()
    assert error < 0.4 * true.square().sum(-1).mean().sqrt()
