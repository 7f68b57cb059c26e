"""One run: an arm learns a task for a number of environment steps, and is tested meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.envs import CatFrames, EnvBase, ExplorationType, InitTracker, TransformedEnv, set_exploration_type
from torchrl.modules import get_primers_from_module

from benchmarks.control import hike, pendulum
from benchmarks.control.arms import ARMS, ENSEMBLE, Arm, clamp, networks
from benchmarks.control.inputs import Seen
from benchmarks.control.learning import Learner, Learning
from benchmarks.control.ppo import PPO, Settings
from torch_denkf.envs import NoisyPendulumEnv
from torch_denkf.filters import DEnKF, Filter
from torch_denkf.transforms import DEnKFTransform


@dataclass(frozen=True)
class Task:
    """A world, what is known of it, and PPO's settings in it.

    Attributes:
        world: many at once, of a count, noise of readings, missing share and seed.
        unlearned: a filter of a number of members.
        exact: the filter that knows the world, of the readings' noise; where there is one.
        steps: of an episode.
        count: worlds at once.
        limit: of an action.
        scale: of a state, for the networks; the readings are in units of the first of them.
        prior: mean and standard deviations of a state anywhere in an episode.
        settings: of PPO.
        learning: of the filter.
    """

    world: Callable[[int, float, float, int], EnvBase]
    unlearned: Callable[[int], DEnKF]
    exact: Callable[[float], Filter] | None
    steps: int
    count: int
    limit: float
    scale: tuple[float, ...]
    prior: tuple[tuple[float, ...], tuple[float, ...]]
    settings: Settings
    learning: Learning


TASKS = {
    "hike": Task(
        hike.MountainHike,
        hike.unlearned_filter,
        hike.exact_filter,
        hike.STEPS,
        count=32,
        limit=1.0,
        scale=(0.2, 0.2),
        prior=((0.8, 0.8), (0.8, 0.8)),
        settings=Settings(gamma=0.99, lmbda=0.95, minibatch=300, slice=25, lr=5e-4),
        learning=Learning(),
    ),
    "pendulum": Task(
        pendulum.world,
        pendulum.unlearned_filter,
        None,
        pendulum.STEPS,
        count=16,
        limit=NoisyPendulumEnv.MAX_TORQUE,
        scale=(1.0, 1.0, NoisyPendulumEnv.MAX_SPEED),
        prior=((0.0, 0.0, 0.0), (0.7, 0.7, 3.0)),
        settings=Settings(gamma=0.95, lmbda=0.9, minibatch=320, slice=40, reward=0.1),
        learning=Learning(window=64, windows=16, first=75, further=6, noise_lr=9e-2),
    ),
}


@dataclass(frozen=True)
class Budget:
    """What all arms of all tasks may use.

    Attributes:
        env_steps: with those that a filter learns from before the policy moves.
        tests: in a run, evenly spaced.
        episodes: of a test.
        members: of an ensemble.
        updates: of a filter, as a share of the task's.
    """

    env_steps: int = 100_000
    tests: int = 5
    episodes: int = 100
    members: int = 32
    updates: float = 1.0


def rollout(env: EnvBase, policy: TensorDictModuleBase | None, steps: int, kind: ExplorationType) -> TensorDict:
    """Whole episodes ``[B, T]``."""
    with torch.no_grad(), set_exploration_type(kind):
        return env.rollout(steps, policy, break_when_any_done=False)


def make_env(task: Task, arm: Arm, count: int, cell: tuple[float, float], seed: int, filter: Filter | None) -> EnvBase:
    """The world with what the arm reads.

    Args:
        task: the world's.
        arm: the reader.
        count: worlds.
        cell: noise of the readings, and missing share.
        seed: of the world.
        filter: the arm's, if any.
    """
    env = TransformedEnv(task.world(count, *cell, seed), InitTracker())
    if filter is not None:
        env.append_transform(DEnKFTransform(filter, store_ensemble=ENSEMBLE in arm.keys))
    if "seen" in arm.keys:
        env.append_transform(Seen(task.scale[0]))
    if arm.stack > 1:
        env.append_transform(CatFrames(arm.stack, dim=-1, in_keys=["seen"], out_keys=["stack"]))
    return env


def run(task_name: str, cell: tuple[float, float], arm_name: str, seed: int, budget: Budget) -> list[dict]:
    """Rows: the return after some numbers of environment steps, and the processor's seconds until then."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    task, arm, spent = TASKS[task_name], ARMS[arm_name], 0.0
    begun = time.process_time()
    filter, learner = None, None
    batch = task.count * task.steps
    batches = max(1, budget.env_steps // batch)
    if arm.filter == "exact":
        filter = task.exact(cell[0])
    elif arm.filter:
        filter = task.unlearned(budget.members)
        learner = Learner(filter, task.prior, batches * task.count, task.learning, arm.filter == "taught")
    env = make_env(task, arm, task.count, cell, 2 * seed, filter)
    tests = make_env(task, arm, budget.episodes, cell, 2 * seed + 1, filter)
    actions = env.full_action_spec["action"].shape[-1]
    seen = env.observation_spec["seen"].shape[-1] if "seen" in arm.keys else 0
    actor, critic = networks(arm, seen, actions, torch.tensor(task.scale))
    policy = TensorDictSequential(actor, *([critic] if arm.memory else []), clamp(task.limit))
    if arm.memory:
        for one in (env, tests):
            one.append_transform(get_primers_from_module(policy))
    ppo = PPO(actor, critic, task.settings, batches, recurrent=bool(arm.memory))
    rows = []
    for number in range(batches):
        random = learner is not None and number == 0
        data = rollout(env, None if random else policy, task.steps, ExplorationType.RANDOM)
        if learner is not None:
            learner.add(data)
            learner.update(round(budget.updates * (task.learning.first if random else task.learning.further)))
        if not random:
            ppo.update(data)
        if (number + 1) * budget.tests // batches > number * budget.tests // batches:
            spent += time.process_time() - begun
            reward = rollout(tests, policy, task.steps, ExplorationType.DETERMINISTIC)["next", "reward"]
            rows.append(
                {
                    "task": task_name,
                    "cell": cell_name(cell),
                    "arm": arm_name,
                    "seed": seed,
                    "env_steps": (number + 1) * batch,
                    "return": reward.sum((1, 2)).mean().item(),
                    "wall_s": spent,
                }
            )
            begun = time.process_time()
    return rows


def cell_name(cell: tuple[float, float]) -> str:
    """Of noise and missing share."""
    noise, missing = cell
    return f"noise {noise:g}" + (f", {missing:.0%} missing" if missing else "")
