r"""
A policy that reads the belief
==============================

A cart is to be held in the middle of a rail. A motor pushes it, and gusts push it, too. A sensor reads where the cart
is, with noise, and every fifth reading is lost. Nobody measures the speed.

A *policy* is the function that chooses the motor's push, here a small network, the *actor*. From one reading it cannot
tell how fast the cart is, so it cannot brake in time. A filter can: its *belief* holds the position and the speed. This
page trains a policy on the belief, and compares it with one on the readings and one on the true state. Then it puts the
filter into the policy, where the filter learns from the reward, too.
"""

# %%
# The environment
# ---------------
# ``LinearGaussianEnv`` is a torchrl environment that is written in torch, so that gradients can go through it. Its
# rewards are zero; a transform of ours writes the reward: it is negative, and the farther off the cart is and the
# stronger the motor pushes, the smaller it is. A missing reading is NaN, which a network cannot read: ``HoldReading``
# writes the last reading that arrived next to it, as ``"held"``. The state is [position in m, speed in m/s].

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import Transform, TransformedEnv
from torchrl.modules import MLP
from torchrl.modules.utils import get_env_transforms_from_module

from torch_denkf import DEnKF, DEnKFTransform, HoldReading, LinearGaussianEnv
from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, Select
from torch_denkf.plots import plot_bands

torch.manual_seed(0)
DT, CARTS, STEPS = 0.1, 32, 60
MOTION = torch.tensor([[1.0, DT], [0.0, 1.0]])
PUSH = torch.tensor([[0.0], [3 * DT]])  # what an action of 1 does to the state in a step


class Reward(Transform):
    """Writes the reward of a state and an action."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        off, push = next_tensordict["state"][..., :1], tensordict["action"]
        return next_tensordict.set("reward", -off.square() - 0.1 * push.square())


def make_env(*transforms: Transform) -> TransformedEnv:
    """Carts on rails; every environment of this page sees the same gusts and the same noise."""
    world = LinearGaussianEnv(
        transition=MOTION,
        observation=torch.tensor([[1.0, 0.0]]),
        transition_std=[0.0, 0.1],
        observation_std=[0.3],
        control=PUSH,
        initial_std=[1.0, 0.5],
        missing=0.2,
        max_steps=STEPS,
        batch_size=[CARTS],
    )
    env = TransformedEnv(world, Reward())
    for transform in (HoldReading(), *transforms):
        env.append_transform(transform)
    return env


# %%
# The filter
# ----------
# The belief is an *ensemble*: 32 guesses of the state. The *transition* moves all guesses by a step; it knows the
# motor's push. Then the reading corrects them. ``DEnKFTransform`` does this behind the environment, at each reset and
# each step. By default it records no gradients (``no_grad=True``). Here the policy is trained by gradients that go
# through the environment, and through the filter.


def make_filter(motor: float = 1.0) -> DEnKF:
    """A filter that believes that the motor has so many times its real strength."""
    moves = torch.nn.Linear(3, 2, bias=False)  # from [position, speed, action] to [position, speed]
    moves.weight.data = torch.cat([MOTION, motor * PUSH], -1)
    return DEnKF(
        transition=LearnedTransition(moves, residual=False, action_key="action"),
        sensor=None,
        observation=Select([0]),
        noise=ConstantNoise([0.3], in_key="observation"),
        initial=GaussianPrior([0.0, 0.0], [1.0, 0.5], ensemble_size=32),
        process_noise=[0.0, 0.1],
        observation_key="observation",
    )


def make_actor(key, width: int) -> TensorDictModule:
    """A small network from an entry to the action."""
    return TensorDictModule(MLP(in_features=width, out_features=1, num_cells=[32]), in_keys=[key], out_keys=["action"])


# %%
# Three policies
# --------------
# The training is short and direct: run 32 carts for some steps, take the mean reward, and follow its gradient.
# torchrl's losses, PPO for example, do the same without a gradient through the environment, and need more runs.


def train(env: TransformedEnv, policy: torch.nn.Module, parameters, updates: int = 40, lr: float = 2e-2) -> None:
    """Follows the gradient of the mean reward."""
    optimiser = torch.optim.Adam(parameters, lr=lr)
    env.set_seed(1)
    for _ in range(updates):
        cost = -env.rollout(25, policy, break_when_any_done=False)["next", "reward"].mean()
        optimiser.zero_grad()
        cost.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimiser.step()


def test(env: TransformedEnv, policy: torch.nn.Module):
    """Costs a step, and the run, of other carts."""
    env.set_seed(2)
    torch.manual_seed(2)
    with torch.no_grad():
        run = env.rollout(STEPS, policy)
    return -run["next", "reward"].mean().item(), run


costs, runs, actors = {}, {}, {}
denkf = make_filter().requires_grad_(False)
for name, key, width, transforms in (
    ("reading", "held", 1, ()),
    ("belief", ("belief", "mean"), 2, (DEnKFTransform(denkf, no_grad=False),)),
    ("truth", "state", 2, ()),
):
    env, actors[name] = make_env(*transforms), make_actor(key, width)
    untrained, _ = test(env, actors[name])
    train(env, actors[name], list(actors[name].parameters()))
    costs[name], runs[name] = test(env, actors[name])
    print(f"policy on the {name:8s}: cost a step {untrained:5.2f} before its training, {costs[name]:.2f} after")
assert costs["belief"] < 0.4 * costs["reading"]
assert costs["truth"] < costs["belief"]

# %%
# The policy on readings lets the carts swing: it pushes towards the middle, and brakes too late. The policy on the
# belief does much better. The policy on the truth shows what a perfect sensor would give; no real robot has one.
#
# The filter in the policy
# ------------------------
# In the environment a filter stays as it is. In the policy it is a part of what is trained, like torchrl's
# ``LSTMModule``. The actor behind it reads ``("belief", "mean")`` as before. Between two steps the environment has to
# carry the last belief and the last action. torchrl calls a transform that adds such entries a *primer*;
# ``get_env_transforms_from_module`` asks the policy for it.
#
# This filter believes that the motor has a fifth of its real strength. The actor is the one that was trained above.
# Only the filter's motion is trained now, by the reward alone.

learner = make_filter(motor=0.2)
policy = TensorDictSequential(learner, actors["belief"].requires_grad_(False))
env = make_env(get_env_transforms_from_module(policy))
print("the primer carries", sorted(str(key) for key in env.observation_spec.keys(True, True) if "previous" in key))
weight = learner["transition"].module["transition"].module.weight
costs["wrong filter"], _ = test(env, policy)
train(env, policy, [weight], updates=30, lr=2e-2)
costs["trained filter"], _ = test(env, policy)
print(f"filter that is wrong about the motor: cost a step {costs['wrong filter']:.2f}")
print(f"after its training by the reward:     cost a step {costs['trained filter']:.2f}")
print("the motion that it learned:", weight.detach(), sep="\n")
assert costs["wrong filter"] > 2 * costs["belief"]
assert costs["trained filter"] < 1.5 * costs["belief"]
assert weight[1, 2] > 3 * DT * 0.5

# %%
# With the wrong filter the carts run away. After the training the cost is about that of the policy on the belief. The
# last column of the learned matrix is what a push does. Its second number began at a fifth of the real one, which is
# ``3 * DT``, and has come near it. It need not equal it: the reward does not ask for the true motion, but for a belief
# with which the actor does well.
#
# One cart under the policy on the belief. The dotted line is the same cart, with the same gusts, under the policy on
# the readings.

run = runs["belief"]["next"][3]
figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
reading = run["observation"][:, 0]
options = {"time": DT * torch.arange(1, STEPS + 1), "observed": run["observed"]}
axes[0].plot(options["time"], runs["reading"]["next", "state"][3, :, 0], "k:", label="truth, policy on readings")
plot_bands(run, dims=[0], names=["position, m"], readings={0: reading}, **options, ax=axes[0])
plot_bands(run, dims=[1], names=["speed, m/s"], **options, legend=False, ax=axes[1])
axes[0].set_xlabel("")
plt.show()

# %%
# From here
# ---------
# * Policies that draw their actions, as those of SAC and PPO do, are
#   ``ProbabilisticTensorDictSequential(filter, *actor)``. What torchrl's losses then need, and programs with PPO, SAC
#   and DDPG: :doc:`/how_to/policies`.
# * Put a filter that is trained already into the environment. Put it into the policy where it is to learn from the
#   reward. The same filter belongs into one of both places.
# * The true motion, learned from recordings: :doc:`plot_training`.
