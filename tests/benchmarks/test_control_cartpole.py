"""The cartpole, its filter and SAC: against dm_control, closed forms, and a task of one step."""

import numpy as np
import pytest
import torch
from dm_control import suite
from tensordict import TensorDict

from benchmarks.control import cartpole
from benchmarks.control.arms import ARMS, Inputs
from benchmarks.control.run import make_env, told
from benchmarks.control.sac import SAC, Settings
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


def test_filter_with_the_true_model_is_consistent():
    torch.manual_seed(0)
    env = make_env(TASKS["cartpole"], ARMS["physics"], 40, (0.1, 0.0), 0, cartpole.exact_filter(0.1, 24))
    belief = env.rollout(60)["next"]
    errors = (belief["belief", "mean"] - belief["state"])[:, 20:].square().mean((0, 1))
    # 1,600 errors, of which some 150 are independent: 5 standard deviations are 0.6; the ensemble costs some percent.
    assert (errors / belief["belief", "var"][:, 20:].mean((0, 1)) - 1).abs().max() < 0.6


def still_filter(members=8):
    """Returns one without process noise, that starts at given members: all its steps are determined."""
    filter = cartpole.unlearned_filter(members)
    torch.manual_seed(0)
    start = torch.tensor(cartpole.START) + 0.1 * torch.randn(members, 5)
    filter = filter.with_modules(initial=FixedEnsemble(start))
    with torch.no_grad():
        filter["transition"].module["noise"].log_variance.fill_(-60.0)
    return filter


def test_analysis_uses_the_given_noise():
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


def test_value_bootstraps_after_a_time_limit():
    """A step's worth is r + gamma V, also where an episode ends by its length; r alone where it is terminated."""
    agent = SAC(ARMS["truth"], Inputs(0, 1, SCALE, 1.0), Settings(gamma=0.9), 1)
    flags = {"done": torch.ones(2, 1, dtype=torch.bool), "terminated": torch.tensor([[False], [True]])}
    after = TensorDict({"reward": torch.full((2, 1), 2.0), "state_value": torch.full((2, 1), 5.0), **flags}, [2])
    worth = agent.loss.value_estimator.value_estimate(TensorDict({"next": after}, [2]))
    torch.testing.assert_close(worth, torch.tensor([[6.5], [2.0]]))
