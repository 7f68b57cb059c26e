"""The humanoid in its harness: it walks on its own legs, goes where the harness goes, and a filter follows it."""

import math

import pytest
import torch

from tests.applications.legged.test_environment import PERFECT
from torch_denkf.applications.legged import legged_filter
from torch_denkf.applications.legged.humanoid import HUMANOID, humanoid_env, stroll
from torch_denkf.functional.manifolds import rotate


def walking(env, steps, **gait):
    td, rows = env.reset(), []
    for step in range(steps):
        begun = min(1.0, step * env.dt)
        td["action"] = stroll(step * env.dt, stride=0.2 * begun, lift=0.4 * begun, **gait)
        td = env.step(td)["next"]
        rows.append(td.exclude("done", "terminated", "truncated", "reward"))
    return torch.stack(rows)


@pytest.fixture(scope="module")
def log():
    return walking(humanoid_env(PERFECT, speed=0.5, turn=0.2), 400).double()


def test_it_walks_upright_on_its_own_legs(log):
    late = log[100:]
    weight = humanoid_env().model.body_mass.sum() * 9.81
    assert late["force"].sum(-1).mean() == pytest.approx(weight, rel=0.1), "the harness carries little"
    up = rotate(late["true", "orientation"], torch.tensor([0.0, 0.0, 1.0]).double())
    assert up[:, 2].min() > 0.95
    assert late["true", "velocity"][:, 0].mean() == pytest.approx(0.5, abs=0.1)
    stands = late["contact"].double()
    assert (stands.diff(dim=0) > 0).sum(0).tolist() == pytest.approx([3, 3], abs=1), "a stride a second"
    assert stands.any(-1).double().mean() > 0.95, "one foot stands"
    turn = late["true", "orientation"]
    heading = 2 * torch.atan2(turn[:, 3], turn[:, 0])
    assert heading[-1] - heading[0] == pytest.approx(0.2 * 3, abs=0.15)


@pytest.mark.parametrize("kind", ["EKF", "DEnKF"])
def test_a_filter_follows_it(kind):
    env = humanoid_env(seed=1)
    log = walking(env, 200).unsqueeze(0)
    filter = legged_filter(env.model, **HUMANOID, dt=env.dt, kind=kind, ensemble_size=48)
    torch.manual_seed(0)
    with torch.no_grad():
        out = filter.sequence(log.clone())
    true = log["true", "velocity"][:, 50:]
    error = (out["belief", "velocity"][:, 50:] - true).square().sum(-1).mean().sqrt()
    assert error < 0.4 * true.square().sum(-1).mean().sqrt()
    assert math.isfinite(out["belief", "velocity_var"].sum())
