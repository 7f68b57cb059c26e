"""Runs of a short cartpole: what the filter knows, which worlds are made, and what the agent is given."""

from dataclasses import replace

import pytest
import torch
from torchrl.envs import ExplorationType

import benchmarks.control.run as protocol
from benchmarks.control import cartpole
from benchmarks.control.learning import Learning
from benchmarks.control.run import Budget, rollout, run
from benchmarks.control.sac import SAC
from benchmarks.control.tasks import TASKS

STEPS = 25
BUDGET = Budget(env_steps=8 * STEPS, tests=1, episodes=2, members=4, updates=0.0)


@pytest.fixture
def worlds(monkeypatch):
    """Count, noise, missing share and seed of each world, in order. Episodes are short; the agent learns nothing."""
    made = []

    def world(*given):
        made.append(given)
        return cartpole.NoisyCartpole(*given)

    learning = Learning(window=STEPS, windows=4)
    monkeypatch.setitem(TASKS, "cartpole", replace(TASKS["cartpole"], world=world, steps=STEPS, learning=learning))
    monkeypatch.setattr(SAC, "update", lambda self, data: None)
    return made


def test_a_run_with_the_shifted_noise_has_no_second_test(worlds, monkeypatch):
    """Its filter knows this noise from the start."""
    known = []

    def noted(env, policy, steps, kind):
        (filter,) = [one.filter for one in env.transform if hasattr(one, "filter")]
        known.append((kind == ExplorationType.DETERMINISTIC, filter["noise"].log_variance.div(2).exp().clone()))
        return rollout(env, policy, steps, kind)

    monkeypatch.setattr(protocol, "rollout", noted)
    assert [row["cell"] for row in run("cartpole", (0.3, 0.0), "physics", 0, BUDGET)] == ["noise 0.3"]
    assert [test for test, _ in known] == [False, True]
    for _, r in known:
        torch.testing.assert_close(r, torch.full((3,), 0.3))
    assert [noise for _, noise, _, _ in worlds] == [0.3, 0.3]


def test_no_shifted_world_is_one_that_was_trained_in(worlds):
    """It is made as the other test's is, so that both begin alike."""
    trained, tested, shifted = set(), set(), set()
    for seed in range(4):
        worlds.clear()
        run("cartpole", (0.1, 0.2), "truth", seed, BUDGET)
        assert [world[:3] for world in worlds] == [(8, 0.1, 0.2), (2, 0.1, 0.2), (2, 0.3, 0.2)]
        for seeds, world in zip((trained, tested, shifted), worlds, strict=True):
            seeds.add(world[3])
        assert worlds[1][3] == worlds[2][3]
    assert len(trained) == len(shifted) == 4
    assert not trained & (tested | shifted)


def test_the_agent_is_given_what_was_filtered_anew(worlds, monkeypatch):
    """After the first, second and third of four batches; of the fourth, what the environment's filter wrote."""
    given = []

    def refiltered(filter, data):
        return data.clone().set(("belief", "mean"), torch.full_like(data["belief", "mean"], 7.0))

    monkeypatch.setattr(protocol, "refiltered", refiltered)
    monkeypatch.setattr(SAC, "update", lambda self, data: given.append(data["belief", "mean"].eq(7.0).all().item()))
    run("cartpole", (0.1, 0.0), "belief mean", 0, replace(BUDGET, env_steps=4 * BUDGET.env_steps))
    assert given == [True, True, True, False]
