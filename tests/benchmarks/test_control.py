"""The study's environments, inputs, filters and statistics, against closed forms."""

import pytest
import torch
from torchrl.envs import ExplorationType
from torchrl.modules import get_primers_from_module, set_recurrent_mode

from benchmarks.control import hike
from benchmarks.control.arms import ARMS, Inputs
from benchmarks.control.ppo import PPO, Head, Settings
from benchmarks.control.run import make_env, rollout
from benchmarks.control.tasks import TASKS


def env_of(task, arm, count=4, cell=(0.2, 0.3), seed=0):
    task, arm = TASKS[task], ARMS[arm]
    filter = task.exact(cell[0]) if arm.filter == "exact" else task.unlearned(8) if arm.filter else None
    return make_env(task, arm, count, cell, seed, filter)


def test_the_exact_filter_holds_the_truth():
    """The squared normalised errors are chi-square distributed, with two degrees of freedom per step."""
    env = make_env(TASKS["hike"], ARMS["Kalman"], 500, (0.4, 0.0), 0, hike.exact_filter(0.4))
    data = env.rollout(hike.STEPS)["next"]
    errors = (data["belief", "mean"] - data["state"]).square() / data["belief", "var"]
    assert errors[:, -1].mean().item() == pytest.approx(1, abs=5 * (2 / 1000) ** 0.5)


def test_policy_input_is_last_reading_and_last_action():
    env = env_of("pendulum", "last reading", count=50)
    data = env.rollout(20)
    seen, reading, observed, action = (data[key] for key in ("seen", "observation", "observed", "action"))
    assert not seen.isnan().any()
    now = observed.expand_as(reading)
    torch.testing.assert_close(seen[..., :2][now], reading[now])
    late = ~observed[:, 1:].expand_as(reading[:, 1:])
    torch.testing.assert_close(seen[:, 1:, :2][late], seen[:, :-1, :2][late])
    assert seen[..., 2].equal(observed.squeeze(-1).float())
    assert seen[:, 1:, 3:].equal(action[:, :-1])
    assert seen[:, 0, 3].eq(0).all()


def test_states_are_read_in_units_of_the_scale():
    """Values 1, 4, 12 are 1, 2, 3 in units of 1, 2, 4."""
    reader, plain = Head(3, 2, torch.tensor([1.0, 2.0, 4.0])), Head(3, 2)
    plain.layers.load_state_dict(reader.layers.state_dict())
    torch.testing.assert_close(reader(torch.tensor([1.0, 4.0, 12.0])), plain(torch.tensor([1.0, 2.0, 3.0])))


def test_a_memory_is_the_same_in_steps_and_in_slices():
    """The probabilities of actions that a batch's slices give are those of the steps that collected it."""
    torch.manual_seed(0)
    task = TASKS["pendulum"]
    env = env_of("pendulum", "LSTM")
    ppo = PPO(ARMS["LSTM"], Inputs(4, 1, torch.tensor(task.scale), task.limit), task.settings, 1)
    actor, critic = ppo.actor, ppo.critic
    with torch.no_grad():
        for network in (actor, critic):  # the last layer begins near zero
            for parameter in network.parameters():
                parameter.add_(0.2 * torch.randn_like(parameter))
    env.append_transform(get_primers_from_module(ppo.policy))
    data = rollout(env, ppo.policy, 80, ExplorationType.RANDOM)
    collected, values = data["raw_log_prob"].clone(), data["state_value"].clone()
    slices = data.exclude("next", "state_value", "actor_memory", "critic_memory").reshape(-1, 40)
    with torch.no_grad(), set_recurrent_mode(True):
        log_prob = actor.get_dist(slices).log_prob(slices["raw"])
        critic(slices)
    torch.testing.assert_close(log_prob.reshape(4, 80), collected, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(slices["state_value"].reshape(4, 80, 1), values, atol=1e-4, rtol=1e-4)
    assert values.std() > 1e-3
    before = [parameter.clone() for parameter in actor.parameters()]
    ppo.update(data)
    assert all((a - b).abs().max() > 0 for a, b in zip(before, actor.parameters(), strict=True))


def test_advantages_and_targets_are_those_of_a_constant_critic():
    """Compares with a closed form: each step is worth f r + (gamma - 1) c, and those to come fade by gamma lambda.

    The end of an episode is a time limit: what comes after it is worth c, too.
    """
    torch.manual_seed(0)
    settings = Settings(gamma=0.9, lmbda=0.8, epochs=2, minibatch=100, reward=0.1)
    ppo, value = PPO(ARMS["truth"], Inputs(0, 2, torch.ones(2), 1.0), settings, 1), 3.0
    with torch.no_grad():
        last = ppo.critic[-1].module.layers[-1]
        last.weight.zero_()
        last.bias.fill_(value)
    data = rollout(env_of("hike", "truth", count=3), ppo.policy, hike.STEPS, ExplorationType.RANDOM)
    reward = data["next", "reward"].clone()
    given, forward = [], ppo.loss.forward
    ppo.loss.forward = lambda part: given.append(part.clone()) or forward(part)
    ppo.update(data)
    assert [part.numel() for part in given] == 2 * [100, 100, 25]  # all of 225 steps, twice
    fade, ahead, advantages = 0.9 * 0.8, torch.zeros(3, 1), []
    for step in reversed(range(hike.STEPS)):
        ahead = 0.1 * reward[:, step] - 0.1 * value + fade * ahead
        advantages.append(ahead)
    expected = torch.cat(advantages).flatten().sort().values
    for epoch in (given[:3], given[3:]):
        found, target = (torch.cat([part[key].flatten() for part in epoch]) for key in ("advantage", "value_target"))
        torch.testing.assert_close(found.sort().values, expected, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(target, found + value, atol=1e-4, rtol=1e-4)
    assert reward.equal(data["next", "reward"])  # the collected ones stay as they were
