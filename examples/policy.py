"""A policy on a belief on one page: a pendulum is swung up by its noisy encoder alone, with torchrl's PPO.

    python examples/policy.py

Nobody measures the speed, and the motor is too weak to lift the pendulum at once. First a filter learns gravity, motor
and gusts from random torques and the encoder alone, by the readings' likelihood (``DEnKFLoss.ad_enkf``): it never sees
the true state. One line appends it to the environment. Then the same PPO is trained three times: on the belief's mean,
on the last reading, and on the last four. Each writes its rewards into ``--out`` as CSV.

It takes about three and a half minutes of one core. Returns of 256 new episodes, and how much of their second half the
pendulum stands upright: about -560, 42 % on the belief; -1100, 7 % on one reading; -940, 22 % on four. One run of each.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import (
    CatFrames,
    EnvBase,
    ExplorationType,
    RewardScaling,
    StepCounter,
    TransformedEnv,
    set_exploration_type,
)
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.record import CSVLogger
from tqdm import tqdm

from torch_denkf import DEnKF, DEnKFLoss, DEnKFTransform, FilterTrainer, Stage
from torch_denkf.modules import ConstantNoise, FromSensor, Select, SubModel

DT, STEPS, NOISE = 0.05, 200, 0.2  # s; of an episode; of the cosine and the sine that the encoder reads
PULL, MOTOR, GUST, TORQUE = 15.0, 3.0, 0.1, 2.0  # 1/s^2; 1/s^2 per Nm; rad/s a step; Nm
INPUTS = {"belief": (("belief", "mean"), 3), "last reading": ("encoder", 2), "four readings": ("encoders", 8)}


def swing(cos: Tensor, sin: Tensor, speed: Tensor, torque: Tensor, pull, motor, gust) -> Tensor:
    """One step of a pendulum; the angle is 0 where it stands upright. To ``[..., 3]``: cosine, sine, speed in rad/s."""
    speed = speed + DT * (pull * sin + motor * torque) + gust * torch.randn_like(speed)
    angle = torch.atan2(sin, cos) + DT * speed
    return torch.cat([angle.cos(), angle.sin(), speed], -1)


class Pendulum(EnvBase):
    """Many pendulums at once: emits the encoder's reading of cosine and sine, and the true state for scores alone."""

    def __init__(self, count: int):
        super().__init__(batch_size=[count])
        self.observation_spec = Composite(state=Unbounded((count, 3)), encoder=Unbounded((count, 2)), shape=[count])
        self.state_spec = Composite({"state": Unbounded((count, 3))}, shape=[count])
        self.action_spec = Bounded(-TORQUE, TORQUE, (count, 1))
        self.reward_spec = Unbounded((count, 1))

    def _emit(self, state: Tensor, **more: Tensor) -> TensorDict:
        encoder = state[..., :2] + NOISE * torch.randn_like(state[..., :2])
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict({"state": state, "encoder": encoder, "done": done, **more}, self.batch_size)

    def _reset(self, tensordict=None, **_) -> TensorDict:
        angle = math.pi * (2 * torch.rand(*self.batch_size, 1) - 1)
        return self._emit(torch.cat([angle.cos(), angle.sin(), 2 * torch.rand_like(angle) - 1], -1))

    def _step(self, tensordict) -> TensorDict:
        cos, sin, speed = tensordict["state"].split(1, -1)
        torque = tensordict["action"].clamp(-TORQUE, TORQUE)
        state = swing(cos, sin, speed, torque, PULL, MOTOR, GUST)
        cost = (
            torch.atan2(sin, cos).square() + 0.1 * speed.square() + 0.001 * torque.square()
        )  # as gym's Pendulum has it
        return self._emit(state, reward=-cost)

    def _set_seed(self, seed) -> None:
        torch.manual_seed(seed)


class Swing(SubModel):
    """The filter's motion: what pulls, how strong the motor is and how strong the gusts are is learned."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "ensemble"), "action"], [("forecast", "ensemble")])
        self.logs = nn.Parameter(torch.zeros(3))  # of pull, motor and gust; all begin at one

    def compute(self, state: Tensor, torque: Tensor) -> Tensor:  # [*B, E, 3], [*B, 1]
        pull, motor, gust = self.logs.exp()
        cos, sin, speed = state.split(1, -1)
        return swing(cos, sin, speed, torque.unsqueeze(-2), pull, motor, gust)


def learn_filter(out: Path, updates: int) -> DEnKF:
    """A filter of [cosine, sine, speed], from random torques and the encoder's readings."""
    denkf = DEnKF(
        transition=Swing(),
        sensor=None,  # the encoder is read as it is
        observation=Select([0, 1]),
        noise=ConstantNoise([NOISE, NOISE], in_key="encoder"),
        initial=FromSensor([0, 1], mean=[0.0] * 3, std=[1.0, 1.0, 1.0], ensemble_size=32, sensor_key="encoder"),
        observation_key="encoder",
    )
    data = Pendulum(256).rollout(60).select("encoder", "action")

    def draw(generator: torch.Generator, length: int) -> TensorDict:
        return data[torch.randint(256, (32,), generator=generator), :length]

    stage = Stage("filter", DEnKFLoss.ad_enkf(denkf), draw, updates, lr=5e-2, lengths={0: 10, updates // 2: 60})
    FilterTrainer(denkf, [stage], out=out / "filter", device="cpu", keep="last").fit(resume=False)
    return denkf


def make_env(kind: str, denkf: DEnKF, count: int) -> TransformedEnv:
    """What a policy sees: the belief, the last reading, or the last four."""
    env = TransformedEnv(Pendulum(count), RewardScaling(0.0, 0.1))
    env.append_transform(StepCounter(STEPS))
    if kind == "belief":
        env.append_transform(DEnKFTransform(denkf, store_ensemble=False))
    if kind == "four readings":
        env.append_transform(CatFrames(4, dim=-1, in_keys=["encoder"], out_keys=["encoders"]))
    return env


def ppo(kind: str, denkf: DEnKF, out: Path, batches: int) -> tuple[Tensor, Tensor]:
    """Trains a policy; then its returns in 256 new episodes, and how much of the time the pendulum stood upright."""
    torch.manual_seed(1)
    key, width = INPUTS[kind]
    size = {"num_cells": [64, 64], "activation_class": nn.Tanh}
    head = nn.Sequential(MLP(width, 2, **size), NormalParamExtractor())
    options = {"distribution_class": TanhNormal, "distribution_kwargs": {"low": -TORQUE, "high": TORQUE}}
    parameters = TensorDictModule(head, [key], ["loc", "scale"])
    actor = ProbabilisticActor(parameters, in_keys=["loc", "scale"], return_log_prob=True, **options)
    critic = ValueOperator(MLP(width, 1, **size), in_keys=[key])
    advantage = GAE(gamma=0.95, lmbda=0.9, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    rows = 64 * 32
    collector = Collector(
        make_env(kind, denkf, 64),
        actor,
        frames_per_batch=rows,
        total_frames=batches * rows,
        auto_register_policy_transforms=True,
    )
    logger = CSVLogger(kind.replace(" ", "-"), log_dir=str(out))
    for number, data in enumerate(bar := tqdm(collector, total=batches, desc=f"PPO on the {kind}", disable=None)):
        for _ in range(6):
            with torch.no_grad():
                advantage(data)
            flat = data.reshape(-1)
            for part in torch.randperm(rows).split(256):
                terms = loss(flat[part])
                optimiser.zero_grad()
                sum(value for name, value in terms.items() if name.startswith("loss")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        reward = 10 * data["next", "reward"].mean().item()
        logger.log_scalar("reward_of_a_step", reward, step=(number + 1) * rows)
        bar.set_postfix(reward=f"{reward:.2f}")
    collector.shutdown()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.manual_seed(2)
        episodes = make_env(kind, denkf, 256).rollout(STEPS, actor)
    upright = (episodes["next", "state"][:, STEPS // 2 :, 0] > 0.9).float().mean()
    return 10 * episodes["next", "reward"].sum((1, 2)), upright


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/policy-page"))
    parser.add_argument("--updates", type=int, default=200, help="of the filter")
    parser.add_argument("--batches", type=int, default=150, help="of PPO, 2,048 steps each")
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    if args.smoke:
        args.out, args.updates, args.batches = args.out.with_name("policy-smoke"), 2, 1
    denkf = learn_filter(args.out, args.updates)
    names = (("pull", PULL, "1/s^2"), ("motor", MOTOR, "1/s^2 per Nm"), ("gusts", GUST, "rad/s a step"))
    for (name, true, unit), learned in zip(names, denkf["transition"].logs.exp().tolist(), strict=True):
        print(f"{name}: learned {learned:.2f} {unit} (true {true})")
    for kind in INPUTS:
        returns, upright = ppo(kind, denkf, args.out, args.batches)
        error = returns.std() / len(returns) ** 0.5
        text = f"return {returns.mean():.0f} ± {error:.0f}, upright in {100 * upright:.0f} % of the second half"
        print(f"PPO on the {kind:<14} {text}")


if __name__ == "__main__":
    main()
