"""A pendulum whose actions run late: a policy on the belief ahead, on the belief of now, on readings.

``python -m benchmarks.control.latency``. The policy is that of the true state without delay, by value iteration on a
grid: nothing is learned, so that all arms differ in what they show it alone. The filter knows the pendulum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import InitTracker, TransformedEnv

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from torch_denkf import DEnKF, DEnKFTransform, NoisyPendulumEnv
from torch_denkf.envs import LateActions
from torch_denkf.fusion import BeliefAhead
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LearnedTransition, Select

DT, SPEED, TORQUE = NoisyPendulumEnv.DT, NoisyPendulumEnv.MAX_SPEED, NoisyPendulumEnv.MAX_TORQUE
STEPS = 200  # of an episode
ARMS = ("belief ahead", "belief", "last two readings", "truth")


@dataclass(frozen=True)
class Latency:
    """Options of the study of late actions."""

    delays: tuple[int, ...] = (2, 4, 8)  # steps of 50 ms, of sensing and inference together
    noises: tuple[float, ...] = (0.02, 0.1)  # of a reading of cosine and sine
    members: int = 32
    seeds: int = 1
    episodes: int = 100  # a seed
    grid: int = 61  # angles, and speeds
    page: Path | None = None  # where to leave the table


def moved(angle: Tensor, speed: Tensor, torque: Tensor) -> tuple[Tensor, Tensor]:
    """One step of the pendulum, 0 rad upright."""
    speed = (speed + DT * (15 * angle.sin() + 3 * torque)).clamp(-SPEED, SPEED)
    return angle + DT * speed, speed


def read_grid(table: Tensor, angle: Tensor, speed: Tensor) -> Tensor:
    """Values between the points of a table ``[N, N]`` of angles, all around, and speeds."""
    count = len(table)
    x = (angle / (2 * torch.pi)).remainder(1.0) * count
    y = (speed.clamp(-SPEED, SPEED) / SPEED + 1) / 2 * (count - 1)
    left, low = x.long().clamp(max=count - 1), y.long().clamp(max=count - 2)
    u, v, right = x - left, y - low, (left + 1) % count
    lower = (1 - u) * table[left, low] + u * table[right, low]
    upper = (1 - u) * table[left, low + 1] + u * table[right, low + 1]
    return (1 - v) * lower + v * upper


def best_policy(count: int, sweeps: int = 400, gamma: float = 0.99) -> Callable[[Tensor], Tensor]:
    """The torque ``[*B, 1]`` that value iteration finds for states ``[*B, 3]``: one step ahead of its values."""
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


def known_filter(noise: float, members: int) -> DEnKF:
    """The pendulum's own motion, on cosine, sine and speed."""

    def step(x: Tensor) -> Tensor:
        angle, speed = moved(torch.atan2(x[..., 1:2], x[..., :1]), x[..., 2:3], x[..., 3:])
        return torch.cat([angle.cos(), angle.sin(), speed], -1)

    return DEnKF(
        LearnedTransition(step, residual=False, action_key="action"),
        None,
        Select([0, 1]),
        ConstantNoise([noise] * 2, in_key="observation"),
        EnsembleAnalysis("etkf", observation_key="observation"),
        initial=GaussianPrior([0.0] * 3, [0.7, 0.7, 0.6], ensemble_size=members),
        process_noise=[0.0, 0.0, 0.05],
        update_at_reset=True,
    )


def returned(
    study: Latency, policy: Callable[[Tensor], Tensor], noise: float, arm: str, delay: int, seed: int
) -> float:
    """The mean return of an arm; ``"nothing"`` is the pendulum without a motor."""
    torch.manual_seed(seed)
    env = NoisyPendulumEnv(noise, max_steps=STEPS, batch_size=[study.episodes], seed=seed)
    env = TransformedEnv(env, InitTracker())
    if delay:
        env.append_transform(LateActions(delay))
    if arm in ("belief", "belief ahead"):
        filter = known_filter(noise, study.members)
        keep = [("belief", "mean")]
        ahead = BeliefAhead(filter, delay, keep=keep) if arm == "belief ahead" and delay else None
        env.append_transform(DEnKFTransform(filter, ahead=ahead))
    before: list[Tensor] = []

    def last_two(reading: Tensor) -> Tensor:
        old = before[-1] if before else reading
        before.append(reading)
        turn = torch.atan2(reading[..., 1:], reading[..., :1]) - torch.atan2(old[..., 1:], old[..., :1])
        return torch.cat([reading, torch.atan2(turn.sin(), turn.cos()) / DT], -1)

    key = {"belief": ("belief", "mean"), "last two readings": "observation"}.get(arm, "state")
    if arm == "belief ahead":
        key = ("ahead", "belief", "mean") if delay else ("belief", "mean")
    seen = {"last two readings": last_two}.get(arm, lambda state: state)
    act = (lambda state: 0 * state[..., 2:]) if arm == "nothing" else (lambda state: policy(seen(state)))
    with torch.no_grad():
        data = env.rollout(STEPS, TensorDictModule(act, [key], ["action"]))
    return data["next", "reward"].sum((1, 2)).mean().item()


def main() -> None:
    """Writes the table."""
    study = parse(Latency)
    policy = best_policy(study.grid)

    def mean(noise: float, arm: str, delay: int) -> float:
        return sum(returned(study, policy, noise, arm, delay, seed) for seed in range(study.seeds)) / study.seeds

    none, truth = (mean(0.0, arm, 0) for arm in ("nothing", "truth"))
    lines = [
        f"{study.seeds * study.episodes} episodes. The return is {none:.0f} without a motor, {truth:.0f} on the truth "
        "without delay. In brackets: the share of what the belief gains over no motor without delay.",
        "",
        *head("noise", "delay, ms", *ARMS),
    ]
    for noise in study.noises:
        full = mean(noise, "belief", 0)
        lines.append(line(noise, 0, "", f"{full:.0f} (100 %)", *[""] * (len(ARMS) - 2)))
        for delay in study.delays:
            cells = [(value, 100 * (value - none) / (full - none)) for value in (mean(noise, a, delay) for a in ARMS)]
            cells = [f"{value:.0f} ({share:.0f} %)" for value, share in cells]
            lines.append(line(noise, round(1000 * DT * delay), *cells))
            print(lines[-1], flush=True)
    write_page("\n".join([*lines, "", *made_by("control.latency"), ""]), study.page)


if __name__ == "__main__":
    main()
