"""Compares policy inputs under action latency: predicted belief, current belief, raw readings; and an LSTM policy.

``python -m benchmarks.control.latency``. The robots are a pendulum and an arm of two links. One fixed policy per robot
is optimal for the true state without delay: value iteration for the pendulum, a linear regulator for the arm. Only its
input changes. The filter has the true motion model. The LSTM is trained by PPO for each delay; its input includes the
actions that were sent and not yet executed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import CatTensors, ExplorationType, FlattenObservation, InitTracker, TransformedEnv
from torchrl.modules import get_primers_from_module

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.control.arms import ARMS, Inputs
from benchmarks.control.ppo import PPO
from benchmarks.control.run import rollout
from benchmarks.control.tasks import RATES, TASKS
from torch_denkf import DEnKF, DEnKFTransform, LinearGaussianEnv, NoisyPendulumEnv
from torch_denkf.envs import LateActions
from torch_denkf.fusion import BeliefAhead
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LearnedTransition, Select

DT, SPEED, TORQUE = NoisyPendulumEnv.DT, NoisyPendulumEnv.MAX_SPEED, NoisyPendulumEnv.MAX_TORQUE
STEPS = 200  # of an episode
SHOWN = ("belief ahead", "belief", "last two readings", "truth")


@dataclass(frozen=True)
class Latency:
    """Options of the latency study."""

    robots: tuple[str, ...] = ("pendulum", "arm")
    delays: tuple[int, ...] = (2, 4, 8)  # steps of 50 ms, of sensing and inference together
    noises: tuple[float, ...] = (0.02, 0.1)  # of a reading
    members: int = 32
    seeds: int = 1
    episodes: int = 100  # per seed
    grid: int = 61  # points along the angle, and along the speed
    env_steps: int = 100_000  # of an LSTM's training, with the first noise; 0 for none
    page: Path | None = None  # file for the table


def moved(angle: Tensor, speed: Tensor, torque: Tensor) -> tuple[Tensor, Tensor]:
    """Returns one step of the pendulum, 0 rad upright."""
    speed = (speed + DT * (15 * angle.sin() + 3 * torque)).clamp(-SPEED, SPEED)
    return angle + DT * speed, speed


def read_grid(table: Tensor, angle: Tensor, speed: Tensor) -> Tensor:
    """Interpolates a table ``[N, N]`` over angles, which are periodic, and speeds."""
    count = len(table)
    x = (angle / (2 * torch.pi)).remainder(1.0) * count
    y = (speed.clamp(-SPEED, SPEED) / SPEED + 1) / 2 * (count - 1)
    left, low = x.long().clamp(max=count - 1), y.long().clamp(max=count - 2)
    u, v, right = x - left, y - low, (left + 1) % count
    lower = (1 - u) * table[left, low] + u * table[right, low]
    upper = (1 - u) * table[left, low + 1] + u * table[right, low + 1]
    return (1 - v) * lower + v * upper


def best_policy(count: int, sweeps: int = 400, gamma: float = 0.99) -> Callable[[Tensor], Tensor]:
    """Returns the torque ``[*B, 1]`` of value iteration for states ``[*B, 3]``, by one step of lookahead."""
    angles, speeds = torch.arange(count) / count * 2 * torch.pi, torch.linspace(-SPEED, SPEED, count)
    torques = torch.linspace(-TORQUE, TORQUE, 17)

    def values(table: Tensor, angle: Tensor, speed: Tensor) -> Tensor:
        turn = torch.atan2(angle.sin(), angle.cos())
        cost = turn.square() + 0.1 * speed.square() + 0.001 * torques.square()
        return -cost + gamma * read_grid(table, *moved(angle, speed, torques))

    table = torch.zeros(count, count)
    for _ in range(sweeps):
        table = values(table, angles.view(-1, 1, 1), speeds.view(1, -1, 1)).amax(-1)

    def policy(state: Tensor) -> Tensor:
        angle, speed = torch.atan2(state[..., 1:2], state[..., :1]), state[..., 2:]
        return torques[values(table, angle, speed).argmax(-1, keepdim=True)]

    return policy


class TwoLinks(LinearGaussianEnv):
    """A horizontal arm of two links and two motors, in steps of 50 ms, with random pushes; the goal is zero angles.

    The state is two angles (rad) and their speeds (rad/s). The angles are read.
    """

    L, M, C, DAMPING, GEAR = 0.2, 0.25, 0.1, 0.05, (0.3, 0.15)  # m, kg, m to a link's middle, Nms, Nm
    PUSH = 0.2  # rad/s in a step

    def __init__(self, noise: float, *, batch_size: tuple[int, ...], seed: int):
        one = torch.eye(4)
        stds = [0.0, 0.0, self.PUSH, self.PUSH], [noise] * 2
        start = {"initial_std": [1.0, 1.0, 0.0, 0.0], "max_steps": STEPS}
        super().__init__(one, one[:2], *stds, control=one[:, 2:], batch_size=batch_size, seed=seed, **start)
        self.action_spec = Bounded(-1.0, 1.0, (*batch_size, 2))

    @classmethod
    def moved(cls, state: Tensor, action: Tensor) -> Tensor:
        """Returns states ``[*B, 4]`` after one step, without a push."""
        one, two, first, second = state.unbind(-1)
        torque = action.clamp(-1, 1) * torch.tensor(cls.GEAR)
        heavy = cls.M * cls.L**2 / 12 + cls.M * cls.C**2  # of a link around its joint
        for _ in range(5):
            mixed = cls.M * cls.L * cls.C * two.cos()
            bend = cls.M * cls.L * cls.C * two.sin()
            force = torque[..., 0] - cls.DAMPING * first + bend * (2 * first + second) * second
            other = torque[..., 1] - cls.DAMPING * second - bend * first**2
            whole, half = 2 * heavy + cls.M * cls.L**2 + 2 * mixed, heavy + mixed
            det = whole * heavy - half**2
            first, second = (
                (first + DT / 5 * (heavy * force - half * other) / det).clamp(-20, 20),
                (second + DT / 5 * (whole * other - half * force) / det).clamp(-20, 20),
            )
            one, two = one + DT / 5 * first, two + DT / 5 * second
        return torch.stack([one, two, first, second], -1)

    def _step(self, tensordict):
        state, action = tensordict["state"], tensordict["action"]
        cost = state[..., :2].square().sum(-1, True) + 0.001 * action.square().sum(-1, True)
        after = self.moved(state, action) + self.transition_std * self._randn(state, 4)
        return self._emit(after, tensordict["step"] + 1).set("reward", -cost)


def regulator(state: Tensor) -> Tensor:
    """Returns the torques ``[*B, 2]`` for the arm's true state."""
    return (-2.0 * state[..., :2] - 0.3 * state[..., 2:]).clamp(-1, 1)


class Robot(NamedTuple):
    """A simulated robot, with the models of its filter and its policy."""

    world: Callable[..., LinearGaussianEnv]  # makes a batch from noise, batch size and seed
    motion: Callable[[Tensor], Tensor]  # maps states and actions to the next states
    start: tuple[list[float], list[float]]  # mean and standard deviations of the first state
    shake: list[float]  # standard deviations of the process noise
    policy: Callable[[Tensor], Tensor]  # maps the true state to actions
    angles: Callable[[Tensor], Tensor]  # maps readings to angles
    state: Callable[[Tensor, Tensor], Tensor]  # joins angles and speeds to a state


def swing(x: Tensor) -> Tensor:
    """Returns the pendulum's next states from cosine, sine, speed and torque."""
    angle, speed = moved(torch.atan2(x[..., 1:2], x[..., :1]), x[..., 2:3], x[..., 3:])
    return torch.cat([angle.cos(), angle.sin(), speed], -1)


@cache
def robot(name: str, grid: int) -> Robot:
    """Returns the pendulum or the arm."""
    if name == "arm":
        motion = lambda x: TwoLinks.moved(x[..., :4], x[..., 4:])  # noqa: E731
        start = [0.0] * 4, [1.0, 1.0, 0.01, 0.01]
        together = lambda angle, speed: torch.cat([angle, speed], -1)  # noqa: E731
        return Robot(TwoLinks, motion, start, [0.0, 0.0, *[TwoLinks.PUSH] * 2], regulator, lambda y: y, together)
    return Robot(
        partial(NoisyPendulumEnv, max_steps=STEPS),
        swing,
        ([0.0] * 3, [0.7, 0.7, 0.6]),
        [0.0, 0.0, 0.05],
        best_policy(grid),
        lambda y: torch.atan2(y[..., 1:], y[..., :1]),
        lambda angle, speed: torch.cat([angle.cos(), angle.sin(), speed], -1),
    )


def known_filter(of: Robot, noise: float, members: int) -> DEnKF:
    """Returns a filter with the robot's true motion."""
    return DEnKF(
        LearnedTransition(of.motion, residual=False, action_key="action"),
        None,
        Select([0, 1]),
        ConstantNoise([noise] * 2, in_key="observation"),
        EnsembleAnalysis("etkf", observation_key="observation"),
        initial=GaussianPrior(*of.start, ensemble_size=members),
        process_noise=of.shake,
        update_at_reset=True,
    )


def late_env(of: Robot, noise: float, delay: int, count: int, seed: int) -> TransformedEnv:
    """Returns an environment of robots whose actions run ``delay`` steps late."""
    env = TransformedEnv(of.world(noise, batch_size=(count,), seed=seed), InitTracker())
    return env.append_transform(LateActions(delay)) if delay else env


def returned(study: Latency, of: Robot, noise: float, shown: str, delay: int, seed: int) -> float:
    """Returns the mean return of the policy on the input ``shown``; ``"nothing"`` is the robot without a motor."""
    torch.manual_seed(seed)
    env = late_env(of, noise, delay, study.episodes, seed)
    if shown in ("belief", "belief ahead"):
        filter = known_filter(of, noise, study.members)
        ahead = BeliefAhead(filter, delay, keep=[("belief", "mean")]) if shown == "belief ahead" and delay else None
        env.append_transform(DEnKFTransform(filter, ahead=ahead))
    before: list[Tensor] = []

    def last_two(reading: Tensor) -> Tensor:
        angle = of.angles(reading)
        old = before[-1] if before else angle
        before.append(angle)
        return of.state(angle, torch.atan2((angle - old).sin(), (angle - old).cos()) / DT)

    key = {"belief": ("belief", "mean"), "last two readings": "observation"}.get(shown, "state")
    if shown == "belief ahead":
        key = ("ahead", "belief", "mean") if delay else ("belief", "mean")
    seen = {"last two readings": last_two}.get(shown, lambda state: state)
    still = env.full_action_spec["action"].zero()
    act = (lambda state: still) if shown == "nothing" else (lambda state: of.policy(seen(state)))
    with torch.no_grad():
        data = env.rollout(STEPS, TensorDictModule(act, [key], ["action"]))
    return data["next", "reward"].sum((1, 2)).mean().item()


def trained(study: Latency, of: Robot, noise: float, delay: int, seed: int) -> float:
    """Returns the mean return of an LSTM trained with this delay."""
    torch.manual_seed(seed)
    task, arm = TASKS["pendulum"], ARMS["LSTM"]

    def make(count: int, seed: int) -> TransformedEnv:
        env, keys = late_env(of, noise, delay, count, seed), ["observation"]
        if delay:
            env.append_transform(FlattenObservation(-2, -1, [("under_way", "action")], ["waiting"]))
            keys.append("waiting")
        return env.append_transform(CatTensors(keys, "seen", del_keys=False, sort=False))

    env, test = make(task.count, 2 * seed), make(study.episodes, 2 * seed + 1)
    spec, batches = env.full_action_spec["action"], max(1, study.env_steps // (task.count * STEPS))
    settings = replace(task.settings, lr=RATES["pendulum", "LSTM"] * task.settings.lr)
    inputs = Inputs(env.observation_spec["seen"].shape[-1], spec.shape[-1], torch.ones(1), spec.space.high.max().item())
    agent = PPO(arm, inputs, settings, batches)
    for one in (env, test):
        one.append_transform(get_primers_from_module(agent.policy))
    for _ in range(batches):
        agent.update(rollout(env, agent.policy, STEPS, ExplorationType.RANDOM))
    return rollout(test, agent.policy, STEPS, ExplorationType.DETERMINISTIC)["next", "reward"].sum((1, 2)).mean().item()


def main() -> None:
    """Writes the table."""
    study = parse(Latency)
    lines = [
        f"Mean return over {study.seeds * study.episodes} episodes, by the policy's input. The percentages put no "
        "motor at 0 and the policy on the belief without delay at 100. An LSTM is trained by PPO for each delay, on "
        f"{study.env_steps:,} steps and one seed.",
        "",
        *head("robot", "sensor noise", "delay (ms)", *SHOWN, "LSTM"),
    ]
    for name in study.robots:
        of = robot(name, study.grid)

        def mean(noise: float, shown: str, delay: int, of: Robot = of) -> float:
            found = [returned(study, of, noise, shown, delay, seed) for seed in range(study.seeds)]
            return sum(found) / study.seeds

        none = mean(0.0, "nothing", 0)
        for noise in study.noises:
            full = mean(noise, "belief", 0)
            for delay in (0, *study.delays):
                values = {shown: mean(noise, shown, delay) for shown in SHOWN}
                if study.env_steps and noise == study.noises[0]:
                    values["LSTM"] = trained(study, of, noise, delay, 0)
                cells = [f"{value:.0f} ({100 * (value - none) / (full - none):.0f} %)" for value in values.values()]
                lines.append(line(name, noise, round(1000 * DT * delay), *cells, *[""] * (len(SHOWN) + 1 - len(cells))))
                print(lines[-1], flush=True)
        lines[0] += f" The {name} returns {none:.0f} without a motor."
    write_page("\n".join([*lines, "", *made_by("control.latency"), ""]), study.page)


if __name__ == "__main__":
    main()
