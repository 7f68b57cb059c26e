"""The tasks: worlds with their settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from torchrl.envs import EnvBase

from benchmarks.control import cartpole, hike, pendulum, ppo, sac
from benchmarks.control.learning import Learning
from torch_denkf.envs import NoisyPendulumEnv
from torch_denkf.filters import DEnKF, Filter


@dataclass(frozen=True)
class Task:
    """A simulated world with its filters, its agent and their settings.

    Attributes:
        world: makes a batch from a count, noise of readings, missing share and seed.
        unlearned: makes a filter before training from a number of members.
        exact: makes the filter with the true model from the readings' noise; ``None`` if there is none.
        steps: of an episode.
        count: batch size of the environment.
        limit: of an action.
        scale: of a state, for the networks; the readings, which are its first entries, have the same units.
        prior: mean and standard deviations of a state anywhere in an episode.
        settings: of PPO, or of SAC.
        learning: of the filter.
        agent: PPO or SAC.
        env_steps: of a run, including random actions.
        shift: noise of the readings in a second test, after all training with ``shift_from``; ``None`` for none.
        shift_from: noise of the readings in training, for cells with a second test.
    """

    world: Callable[[int, float, float, int], EnvBase]
    unlearned: Callable[[int], DEnKF]
    exact: Callable[[float], Filter] | None
    steps: int
    count: int
    limit: float
    scale: tuple[float, ...]
    prior: tuple[tuple[float, ...], tuple[float, ...]]
    settings: ppo.Settings | sac.Settings
    learning: Learning
    agent: type[ppo.PPO] | type[sac.SAC] = ppo.PPO
    env_steps: int = 100_000
    shift: float | None = None
    shift_from: float = 0.1


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
        settings=ppo.Settings(gamma=0.99, lmbda=0.95, minibatch=300, slice=25, lr=5e-4),
        learning=Learning(window=None, first=60, further=4, guess=True),
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
        settings=ppo.Settings(gamma=0.95, lmbda=0.9, minibatch=320, slice=40, reward=0.1),
        learning=Learning(window=64, windows=16, first=75, further=6, noise_lr=9e-2),
    ),
    "cartpole": Task(
        cartpole.NoisyCartpole,
        cartpole.unlearned_filter,
        cartpole.exact_filter,
        cartpole.STEPS,
        count=8,
        limit=1.0,
        scale=cartpole.SCALE,
        prior=((0.0,) * 5, (0.7, 0.7, 0.7, 1.5, 4.0)),
        settings=sac.Settings(),
        learning=Learning(window=25, windows=64, first=120, further=20, pieces=10, within=1.5),
        agent=sac.SAC,
        env_steps=80_000,
        shift=0.3,
    ),
}
TASKS["cartpole-full"] = replace(
    TASKS["cartpole"],
    world=partial(cartpole.NoisyCartpole, read=5),
    unlearned=partial(cartpole.unlearned_filter, read=5),
    exact=partial(cartpole.exact_filter, read=5),
)

RATES = {  # of PPO: factors on a task's learning rate, the best of .3, 1, 3, 10 on three other seeds; others have 1
    **dict.fromkeys([("hike", "belief mean"), ("hike", "last reading")], 0.3),
    **dict.fromkeys([("pendulum", arm) for arm in ("LSTM", "last reading", "four readings")], 3.0),
}
