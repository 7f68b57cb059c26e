"""One run: trains an arm on a task for a number of environment steps, with tests in between."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import CatFrames, EnvBase, ExplorationType, InitTracker, TransformedEnv, set_exploration_type
from torchrl.modules import get_primers_from_module

from benchmarks.control import ppo, sac
from benchmarks.control.arms import ARMS, Arm, Inputs, Seen
from benchmarks.control.learning import Learner, refiltered
from benchmarks.control.tasks import RATES, TASKS, Task
from torch_denkf.filters import Filter
from torch_denkf.transforms import DEnKFTransform

NOT_TRAINED = "not trained"
SHIFTED = f"{{}}, {NOT_TRAINED}"
LEFT = f"{SHIFTED}, R as learned"


@contextmanager
def told(filter: Filter | None, noise: float) -> Iterator[None]:
    """Sets R of a filter to the square of ``noise`` within a context; nothing else changes."""
    if filter is None:
        yield
        return
    log_variance = filter["noise"].log_variance
    learned = log_variance.detach().clone()
    with torch.no_grad():
        log_variance.fill_(2 * math.log(noise))
    try:
        yield
    finally:
        with torch.no_grad():
            log_variance.copy_(learned)


@dataclass(frozen=True)
class Budget:
    """Budget of a run, the same for all arms of all tasks.

    Attributes:
        env_steps: environment steps; ``None`` for the task's.
        tests: in a run, evenly spaced.
        episodes: of a test.
        members: of an ensemble.
        updates: of a filter, as a share of the task's.
        every: environment steps for each update of SAC; ``None`` for the task's.
    """

    env_steps: int | None = None
    tests: int = 5
    episodes: int = 100
    members: int = 32
    updates: float = 1.0
    every: int | None = None


def batches_of(task: Task, budget: Budget) -> tuple[int, list[int]]:
    """Returns the number of batches of episodes in a run, and the batches that are followed by a test."""
    batches = max(1, (budget.env_steps or task.env_steps) // (task.count * task.steps))
    return batches, [number for number in range(1, batches + 1) if number * budget.tests % batches < budget.tests]


def shifted_names(task: Task, cell: tuple[float, float]) -> list[str]:
    """Returns the names of the tests with more noise than in training, with the new R and with the learned R.

    Cells whose noise does not change after training have none.
    """
    if task.shift is None or cell[0] != task.shift_from:
        return []
    return [text.format(cell_name((task.shift, cell[1]))) for text in (SHIFTED, LEFT)]


def rollout(env: EnvBase, policy: TensorDictModuleBase | None, steps: int, kind: ExplorationType) -> TensorDict:
    """Returns whole episodes ``[B, T]``."""
    with torch.no_grad(), set_exploration_type(kind):
        return env.rollout(steps, policy, break_when_any_done=False)


def make_env(task: Task, arm: Arm, count: int, cell: tuple[float, float], seed: int, filter: Filter | None) -> EnvBase:
    """Returns the environment with the inputs of the arm.

    Args:
        task: of the environment.
        arm: that reads it.
        count: batch size.
        cell: noise of the readings, and missing share.
        seed: of the environment.
        filter: the arm's, if any.
    """
    env = TransformedEnv(task.world(count, *cell, seed), InitTracker())
    if filter is not None:
        env.append_transform(DEnKFTransform(filter, store_ensemble=arm.end_to_end))
    if arm.key == "seen":
        env.append_transform(Seen(torch.tensor(task.scale[: env.observation_spec["observation"].shape[-1]])))
    if arm.stack > 1:
        env.append_transform(CatFrames(arm.stack, dim=-1, in_keys=["seen"], out_keys=["stack"]))
    return env


def run(task_name: str, cell: tuple[float, float], arm_name: str, seed: int, budget: Budget) -> list[dict]:
    """Returns a row for each test: the return, and the processor's seconds of training until then."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    task, arm, spent = TASKS[task_name], ARMS[arm_name], 0.0
    begun = time.process_time()
    filter, learner = None, None
    batches, tested = batches_of(task, budget)
    if arm.filter == "exact":
        filter = task.exact(cell[0])
    elif arm.filter:
        filter = task.unlearned(budget.members)
        learner = Learner(filter, task.prior, batches * task.count, task.learning, arm.filter == "taught")
    env = make_env(task, arm, task.count, cell, 2 * seed, filter)
    tests = make_env(task, arm, budget.episodes, cell, 2 * seed + 1, filter)
    seen = env.observation_spec["seen"].shape[-1] if arm.key == "seen" else 0
    actions = env.full_action_spec["action"].shape[-1]
    settings = task.settings
    if isinstance(settings, sac.Settings):
        settings = replace(settings, every=budget.every or settings.every)
    elif isinstance(settings, ppo.Settings):
        settings = replace(settings, lr=RATES.get((task_name, arm_name), 1.0) * settings.lr)
    inputs = Inputs(seen, actions, torch.tensor(task.scale), task.limit)
    within = {"filter": filter} if arm.end_to_end else {}
    agent = task.agent(arm, inputs, settings, batches, **within)
    if arm.memory:
        for one in (env, tests):
            one.append_transform(get_primers_from_module(agent.policy))
    rows = []

    def test(name: str, env: EnvBase) -> None:
        reward = rollout(env, agent.policy, task.steps, ExplorationType.DETERMINISTIC)["next", "reward"]
        returned = reward.sum((1, 2)).mean().item()
        steps = (number + 1) * task.count * task.steps
        entries = {"arm": arm_name, "seed": seed, "env_steps": steps, "return": returned}
        rows.append({"task": task_name, "cell": name, **entries, "wall_s": spent})

    for number in range(batches):
        random = number == 0 and (learner is not None or not agent.ON_POLICY)
        data = rollout(env, None if random else agent.policy, task.steps, ExplorationType.RANDOM)
        if learner is not None:
            learner.add(data)
            learner.update(round(budget.updates * (task.learning.first if random else task.learning.further)))
            if not agent.ON_POLICY and number & (number - 1) == 0:  # after 1, 2, 3, 5, 9, 17 ... batches
                data = refiltered(filter, data)
                agent.refilter(filter)
        if not (random and agent.ON_POLICY):
            agent.update(data)
        if number + 1 in tested:
            spent += time.process_time() - begun
            test(cell_name(cell), tests)
            begun = time.process_time()
    if names := shifted_names(task, cell):
        shifted = make_env(task, arm, budget.episodes, (task.shift, cell[1]), 2 * seed + 1, filter)
        if arm.memory:
            shifted.append_transform(get_primers_from_module(agent.policy))
        with told(filter, task.shift):
            test(names[0], shifted)
        if filter is not None:
            test(names[1], shifted)
    return rows


def cell_name(cell: tuple[float, float]) -> str:
    """Returns the name of a cell: noise and missing share."""
    noise, missing = cell
    return f"noise {noise:g}" + (f", {missing:.0%} missing" if missing else "")
