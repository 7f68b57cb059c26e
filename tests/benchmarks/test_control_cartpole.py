"""The cartpole, its filter and SAC: against dm_control, closed forms, and a task of one step."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from dm_control import suite
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import get_primers_from_module, set_recurrent_mode

import benchmarks.control.run as protocol
from benchmarks.control import cartpole
from benchmarks.control.arms import ARMS, Inputs
from benchmarks.control.learning import Learner, refiltered
from benchmarks.control.page import page
from benchmarks.control.run import Budget, make_env, rollout, run
from benchmarks.control.sac import SAC, Settings
from benchmarks.control.shift import told
from benchmarks.control.tasks import TASKS
from tests.filters.factories import FixedEnsemble

SCALE = torch.tensor(cartpole.SCALE)


def test_physics_and_reward_are_those_of_dm_control():
    ours, theirs = cartpole.NoisyCartpole(3, 0.1, action_noise=0.0), suite.load("cartpole", "swingup")
    torch.manual_seed(0)
    data = ours.rollout(60)
    for row in data:
        with theirs.physics.reset_context():
            theirs.reset()
            position, cos, sin, velocity, turn = row["state"][0].double().tolist()
            theirs.physics.data.qpos[:] = position, np.arctan2(sin, cos)
            theirs.physics.data.qvel[:] = velocity, turn
        for step in row:
            rewards = [theirs.step(step["action"].numpy()).reward for _ in range(cartpole.REPEAT)]
            assert step["next", "reward"].item() == pytest.approx(sum(rewards), abs=1e-3)
        physics = theirs.physics
        there = [*physics.bounded_position(), *physics.velocity()]
        np.testing.assert_allclose(row["next", "state"][-1].numpy(), there, atol=1e-3)
    assert data["next", "state"][:, -1, 3:].abs().max() > 0.1


def test_noises_are_what_they_are_said_to_be():
    count = 3000
    data = cartpole.NoisyCartpole(count, 0.2).rollout(1, lambda td: td.set("action", torch.zeros(count, 1)))[:, 0]
    spread = 5 / (2 * count) ** 0.5
    reading = (data["observation"] - data["state"][:, :3]).std(0)
    torch.testing.assert_close(reading, torch.full((3,), 0.2), rtol=spread, atol=0)
    # Near the start a velocity is proportional to what the motor got.
    still = cartpole.NoisyCartpole(count, 0.2, action_noise=0.0)
    one = still.rollout(1, lambda td: td.set("action", 0.1 * torch.ones(count, 1)))[:, 0]
    gain = (one["next", "state"] - one["state"])[:, 3].mean() / 0.1
    motor = (data["next", "state"] - data["state"])[:, 3] / gain
    mean_of = cartpole.REPEAT**0.5  # independent noises, one in each physics step
    assert motor.std().item() == pytest.approx(cartpole.ACTION_NOISE / mean_of, rel=spread + 0.02)


def test_the_filter_that_knows_the_world_moves_as_the_world_does(monkeypatch):
    monkeypatch.setattr(cartpole, "ACTION_NOISE", 0.0)
    env = cartpole.NoisyCartpole(4, 0.1, action_noise=0.0)
    data = env.rollout(40)
    physics = cartpole.exact_filter(0.1)["transition"]
    moved = physics.compute(data["state"].unsqueeze(-2).expand(-1, -1, 3, -1), data["action"])
    torch.testing.assert_close(moved, data["next", "state"].unsqueeze(-2).expand_as(moved))


def test_the_filter_that_knows_the_world_errs_as_it_believes():
    torch.manual_seed(0)
    env = make_env(TASKS["cartpole"], ARMS["physics"], 40, (0.1, 0.0), 0, cartpole.exact_filter(0.1, 24))
    belief = env.rollout(60)["next"]
    errors = (belief["belief", "mean"] - belief["state"])[:, 20:].square().mean((0, 1))
    # 1,600 errors, of which some 150 are independent: 5 standard deviations are 0.6; the ensemble costs some percent.
    assert (errors / belief["belief", "var"][:, 20:].mean((0, 1)) - 1).abs().max() < 0.6


def test_readings_know_nothing_of_velocities_unless_these_are_read():
    row = cartpole.NoisyCartpole(2, 0.0).reset()
    state = row["state"][:1] + torch.tensor([[0.0] * 5, [0.0, 0.0, 0.0, 5.0, 5.0]])
    for task, read in (("cartpole", 3), ("cartpole-full", 5)):
        env = TASKS[task].world(2, 0.0, 0.0, 0)
        reading = state @ env.H.mT
        assert reading[0].equal(reading[1]) == (read == 3)
        assert reading[1].equal(state[1, :read])
        assert env.observation_spec["observation"].shape == (2, read)


def still_filter(members=8):
    """One without process noise, that starts at given members: all its steps are determined."""
    filter = cartpole.unlearned_filter(members)
    torch.manual_seed(0)
    start = torch.tensor(cartpole.START) + 0.1 * torch.randn(members, 5)
    filter = filter.with_modules(initial=FixedEnsemble(start))
    with torch.no_grad():
        filter["transition"].module["noise"].log_variance.fill_(-60.0)
    return filter


def test_what_is_filtered_once_more_is_what_was_filtered_in_the_environment():
    filter = still_filter()
    env = make_env(TASKS["cartpole"], ARMS["belief mean, spread"], 4, (0.1, 0.0), 0, filter)
    data = rollout(env, None, 30, ExplorationType.RANDOM)
    again = data.clone()
    for key in ("mean", "var"):
        for place in (("belief", key), ("next", "belief", key)):
            again.set(place, torch.zeros_like(data[place]))
    again = refiltered(filter, again)
    for key in ("mean", "var"):
        torch.testing.assert_close(again["belief", key], data["belief", key], atol=1e-4, rtol=1e-3)
        torch.testing.assert_close(again["next", "belief", key], data["next", "belief", key], atol=1e-4, rtol=1e-3)
    assert data["next", "belief", "mean"].std(1).min() > 0


def test_what_the_filter_is_told_is_what_the_analysis_uses():
    """The first belief is the Kalman update of the prior's members, with R = 0.3^2 while it is told so."""
    filter = still_filter()
    reading = torch.tensor([[0.5, -0.5, 0.5]])
    frame = TensorDict({"observation": reading, "observed": torch.ones(1, 1, dtype=torch.bool)}, [1])
    members = filter.initial(frame.copy())["belief", "ensemble"][0]
    mean, cov = members.mean(0), members.T.cov()

    def update(noise):
        gain = cov[:, :3] @ (cov[:3, :3] + noise**2 * torch.eye(3)).inverse()
        return mean + gain @ (reading[0] - mean[:3]), (cov - gain @ cov[:3]).diagonal()

    def belief():
        with torch.no_grad():
            out = filter.initialise(frame.copy())["belief"]
        return out["mean"][0], out["var"][0]

    for _ in range(2):
        torch.testing.assert_close(belief(), update(0.2), atol=1e-5, rtol=1e-3)
        with told(filter, 0.3):
            torch.testing.assert_close(belief(), update(0.3), atol=1e-5, rtol=1e-3)
    assert not torch.allclose(belief()[0], update(0.3)[0], atol=1e-3)


@pytest.mark.slow
def test_a_filter_learns_the_cartpole_from_readings_alone():
    """The noise of the readings within 10 %; velocities to 0.3 m/s and 0.4 rad/s, as it believes."""
    torch.manual_seed(0)
    filter = cartpole.unlearned_filter(16)
    task = TASKS["cartpole"]
    learner = Learner(filter, task.prior, 32, task.learning)
    learner.add(rollout(cartpole.NoisyCartpole(32, 0.1), None, cartpole.STEPS, ExplorationType.RANDOM))
    assert learner.episodes[:]["observation"][..., 0].abs().max() <= task.learning.within  # the ends of the track
    learner.update(100)
    noise = filter["noise"].log_variance.div(2).exp()
    torch.testing.assert_close(noise, torch.full((3,), 0.1), rtol=0.1, atol=0)
    test = cartpole.NoisyCartpole(64, 0.1, seed=1).rollout(50).exclude("next")
    inside = test["state"][..., 0].abs().cummax(1).values < 1.5
    with torch.no_grad():
        belief = filter.sequence(test.copy())["belief"]
    error = (belief["mean"] - test["state"])[inside].square().mean(0).sqrt()
    assert error[3] < 0.3
    assert error[4] < 0.4
    torch.testing.assert_close(belief["var"][inside].mean(0).sqrt(), error, rtol=0.3, atol=0)


def test_sac_learns_to_do_what_it_reads():
    """One step, whose reward is highest where the action is the first entry of the state."""
    torch.manual_seed(0)
    agent = SAC(ARMS["truth"], Inputs(0, 1, SCALE, 1.0), Settings(every=8, units=32, lr=3e-3, target=0.9), 1)
    state, action = 1.6 * torch.rand(400, 10, 5) - 0.8, 2 * torch.rand(400, 10, 1) - 1
    over = torch.ones(400, 10, 1, dtype=torch.bool)
    after = {"state": state, "done": over, "terminated": over, "is_init": ~over}
    after["reward"] = -10 * (action - state[..., :1]).square()
    before = {"state": state, "action": action, **dict.fromkeys(("is_init", "done", "terminated"), over)}
    agent.update(TensorDict({**before, "next": after}, [400, 10]))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        done = agent.policy(TensorDict({"state": state[:, 0]}, [400]))["action"]
    assert (done - state[:, 0, :1]).square().mean().sqrt() < 0.15


def test_a_memory_is_the_same_in_steps_and_in_slices():
    """The means of actions that a sample's slices give are those of the steps that collected it."""
    torch.manual_seed(0)
    settings = Settings(every=10_000, recurrent_batch=64, slice=16)
    agent = SAC(ARMS["LSTM"], Inputs(5, 1, SCALE, 1.0), settings, 1)
    with torch.no_grad():
        for parameter in agent.actor.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    env = make_env(TASKS["cartpole"], ARMS["LSTM"], 4, (0.1, 0.0), 0, None)
    env.append_transform(get_primers_from_module(agent.policy))
    data = rollout(env, agent.policy, cartpole.STEPS, ExplorationType.RANDOM)
    agent.keys += ["loc", "step"]
    agent.update(data)
    sample = agent.buffer.sample().reshape(-1, 16)
    assert sample["step"].diff(dim=1).eq(1).all()  # no slice is of two episodes
    collected = sample["loc"].clone()
    with torch.no_grad(), set_recurrent_mode(True):
        means = agent.actor.get_dist(sample.exclude("loc")).loc
    torch.testing.assert_close(means.reshape(collected.shape), collected, atol=1e-5, rtol=1e-4)
    assert collected.std() > 1e-3


def test_what_the_buffer_holds_is_filtered_once_more():
    """All that is kept stays in its place; beliefs become what the filter that is used now says of whole episodes."""
    filter, arm = still_filter(), ARMS["belief mean, spread"]
    agent = SAC(arm, Inputs(0, 1, SCALE, 1.0), Settings(every=10_000), 3)
    agent.refilter(filter)  # nothing is kept yet
    env = make_env(TASKS["cartpole"], arm, 4, (0.1, 0.0), 0, filter)
    batches = [rollout(env, agent.policy, 30, ExplorationType.RANDOM) for _ in range(3)]
    for data in batches[:2]:
        agent.update(data)
    before = agent.buffer[:].clone()
    with told(filter, 0.5):
        agent.refilter(filter)
        expected = refiltered(filter, torch.cat(batches[:2])).reshape(-1)
    after = agent.buffer[:]
    for key in ("belief", "mean"), ("belief", "var"), ("next", "belief", "mean"), ("next", "belief", "var"):
        torch.testing.assert_close(after[key], expected[key], atol=1e-4, rtol=1e-3)
        assert not torch.allclose(after[key], before[key], atol=1e-2)
    for key in "observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done"):
        assert after[key].equal(before[key])
    agent.update(batches[2])
    assert len(agent.buffer) == 360
    torch.testing.assert_close(agent.buffer[240:]["belief", "mean"], batches[2]["belief", "mean"].reshape(-1, 5))


def test_what_comes_after_a_time_limit_counts():
    """A step's worth is r + gamma V, also where an episode ends by its length; r alone where it is terminated."""
    agent = SAC(ARMS["truth"], Inputs(0, 1, SCALE, 1.0), Settings(gamma=0.9), 1)
    flags = {"done": torch.ones(2, 1, dtype=torch.bool), "terminated": torch.tensor([[False], [True]])}
    after = TensorDict({"reward": torch.full((2, 1), 2.0), "state_value": torch.full((2, 1), 5.0), **flags}, [2])
    worth = agent.loss.value_estimator.value_estimate(TensorDict({"next": after}, [2]))
    torch.testing.assert_close(worth, torch.tensor([[6.5], [2.0]]))


def test_slices_come_from_all_batches_and_from_within_episodes():
    torch.manual_seed(0)
    agent = SAC(ARMS["LSTM"], Inputs(5, 1, SCALE, 1.0), Settings(every=10_000, slice=50), 3)
    env = make_env(TASKS["cartpole"], ARMS["LSTM"], 2, (0.1, 0.0), 0, None)
    env.append_transform(get_primers_from_module(agent.policy))
    agent.keys += ["step", "number"]
    for number in range(3):
        data = rollout(env, agent.policy, cartpole.STEPS, ExplorationType.RANDOM)
        agent.update(data.set("number", torch.full((2, cartpole.STEPS, 1), number)))
        slices = torch.cat([agent.buffer.sample().reshape(-1, 50) for _ in range(20)])
        assert slices["step"].diff(dim=1).eq(1).all()
        shares = slices["number"][:, 0, 0].bincount() / len(slices)
        # 200 slices: a share's standard deviation is at most 0.036.
        torch.testing.assert_close(shares, torch.full((number + 1,), 1 / (number + 1)), atol=0.15, rtol=0)


def test_an_update_follows_so_many_steps():
    """Six of 120 steps; the targets follow the first, of what is learned they keep 90 %."""
    agent = SAC(ARMS["truth"], Inputs(0, 1, SCALE, 1.0), Settings(every=20, batch=7, target=0.9), 1)
    given, forward, targets = [], agent.loss.forward, []

    def noted(sample):
        given.append(sample.numel())
        targets.append([values.detach().clone() for values in (learned(), followed())])
        return forward(sample)

    def learned():
        return torch.cat([value.flatten() for value in agent.loss.qvalue_network_params.values(True, True)])

    def followed():
        return torch.cat([value.flatten() for value in agent.loss.target_qvalue_network_params.values(True, True)])

    agent.loss.forward = noted
    env = make_env(TASKS["cartpole"], ARMS["truth"], 4, (0.1, 0.0), 0, None)
    agent.update(rollout(env, None, 30, ExplorationType.RANDOM))
    assert given == 6 * [7]
    torch.testing.assert_close(targets[0][0], targets[0][1])
    torch.testing.assert_close(targets[1][1], 0.9 * targets[0][1] + 0.1 * targets[1][0])
    assert not targets[1][0].equal(targets[0][0])
    assert agent.loss.target_entropy.item() == -1.0  # minus the number of actions


@pytest.mark.parametrize(
    ("name", "arm"),
    [
        ("cartpole", "belief mean"),
        ("cartpole", "four readings"),
        pytest.param("cartpole-full", "physics", marks=pytest.mark.slow),
    ],
)
def test_a_run_is_tested_where_it_was_trained_and_where_it_was_not(name, arm, monkeypatch):
    """Of each test the world's noise, and the filter's."""
    task, tested = TASKS[name], []
    monkeypatch.setitem(TASKS, name, replace(task, count=2, settings=replace(task.settings, every=500)))

    def noted(env, policy, steps, kind):
        if kind == ExplorationType.DETERMINISTIC:
            r = [one.filter["noise"].log_variance.div(2).exp() for one in env.transform if hasattr(one, "filter")]
            tested.append((env.observation_std[0].item(), *(each.detach().clone() for each in r)))
        return rollout(env, policy, steps, kind)

    monkeypatch.setattr(protocol, "rollout", noted)
    budget = Budget(env_steps=500, tests=1, episodes=2, members=4, updates=0.02)
    names = [row["cell"] for row in run(name, (0.1, 0.0), arm, 0, budget)]
    left = ["noise 0.3, not trained, R as learned"] * (arm != "four readings")
    assert names == ["noise 0.1", "noise 0.3, not trained", *left]
    assert [one[0] for one in tested] == pytest.approx([0.1, 0.3, 0.3][: len(names)])
    if left:
        (_, learned), (_, told_of), (_, as_learned) = tested
        read = 5 if name == "cartpole-full" else 3
        torch.testing.assert_close(told_of, torch.full((read,), 0.3))
        assert as_learned.equal(learned)
        if arm == "physics":
            torch.testing.assert_close(learned, torch.full((read,), 0.1))


def test_the_page_says_what_is_lost():
    """800 to 760 and 900 to 810 are 5 and 10 percent."""
    values = {"noise 0.1": (800.0, 900.0), "noise 0.3, not trained": (760.0, 810.0)}
    rows = [
        {"task": "cartpole", "cell": cell, "arm": arm, "seed": seed, "env_steps": 1000, "return": value, "wall_s": 1.0}
        for cell, both in values.items()
        for arm in ("LSTM", "belief mean")
        for seed, value in enumerate(both)
    ]
    text = page(rows)
    assert "Percent of the return with noise 0.1 that is lost, with the same seeds." in text
    assert "| noise 0.3, not trained | 7.5 [5.0, 10.0] | 7.5 [5.0, 10.0] |" in text
    assert "control.png" not in text
    few = [row for row in rows if "not trained" not in row["cell"] or row["seed"] == 1]
    few += [{**row, "cell": "noise 0.3", "return": 720.0} for row in rows if row["cell"] == "noise 0.1" and row["seed"]]
    text = page(few)
    assert "| noise 0.3, not trained | 10.0 | 10.0 |" in text
    assert "| noise 0.3 | 20.0 | 20.0 |" in text
