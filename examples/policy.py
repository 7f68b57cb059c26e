"""A policy on a belief on one page: a pendulum's swing-up from a noisy encoder alone, with torchrl's PPO.

    python examples/policy.py                # CSV files and a learning curve in runs/policy
    python examples/policy.py --tensorboard

The speed is not measured, and the motor is too weak to lift the pendulum at once. One line appends a filter to the
environment. The filter learns gravity and motor from the policy's data during collection, by the likelihood of
the readings (``DEnKFLoss.ad_enkf``), without the true state. recurrent_policy.py is the same with torchrl's LSTM.

It takes about one minute of one core. Return of 100 new episodes after 99,200 steps: -188 on the belief, and -236 with
the LSTM (one run each); a policy that reads the true state returns about -150. The filter ends with a pull of 15.00
and a motor of 3.01, which are 15 and 3.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase, ExplorationType, ObservationNorm, TransformedEnv, set_exploration_type
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torch_denkf import DEnKF, DEnKFLoss, DEnKFTransform, NoisyPendulumEnv
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, NoisyTransition, Select, Transition
from torch_denkf.training import RunLogs

COUNT, STEPS, NOISE = 16, 200, 0.1  # pendulums in a batch; steps of an episode; noise of the read cosine and sine


class Swing(Transition):
    """The filter's motion: pull of gravity, in 1/s^2, and strength of the motor, in 1/s^2 per Nm, are learned."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "ensemble"), "action"], [("forecast", "ensemble")])
        self.tenths = nn.Parameter(torch.zeros(2))

    def compute(self, state: Tensor, torque: Tensor) -> Tensor:  # [*B, E, 3]: cosine, sine, rad/s; [*B, 1]
        pull, motor = 10 * self.tenths
        torque = torque.clamp(-NoisyPendulumEnv.MAX_TORQUE, NoisyPendulumEnv.MAX_TORQUE)
        cos, sin, speed = state.split(1, -1)
        speed = speed + NoisyPendulumEnv.DT * (pull * sin + motor * torque.unsqueeze(-2))
        speed = speed.clamp(-NoisyPendulumEnv.MAX_SPEED, NoisyPendulumEnv.MAX_SPEED)
        angle = torch.atan2(sin, cos) + NoisyPendulumEnv.DT * speed
        return torch.cat([angle.cos(), angle.sin(), speed], -1)


class LearningFilter:
    """A filter of [cosine, sine, speed], and its training on all episodes ``[B, T]`` so far."""

    def __init__(self, episodes: int):
        gusts = ConstantNoise([0.3], trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise"))
        parts = {
            "transition": NoisyTransition(Swing(), gusts, dims=[2], before=True),
            "sensor": None,  # the encoder is read directly
            "observation": Select([0, 1]),
            "noise": ConstantNoise([0.5, 0.5], trainable=True, in_key="observation"),
            "analysis": EnsembleAnalysis("etkf", observation_key="observation"),
        }
        first, later = (GaussianPrior([0.0] * 3, [0.7, 0.7, speed], ensemble_size=32) for speed in (0.6, 3.0))
        self.filter = DEnKF(**parts, initial=first, update_at_reset=True)
        # Windows begin anywhere in an episode, with an unknown speed.
        self.loss = DEnKFLoss.ad_enkf(DEnKF(**parts, initial=later, update_at_reset=True))
        self.optimiser = torch.optim.Adam(self.filter.parameters(), lr=0.05)
        self.schedule = torch.optim.lr_scheduler.ExponentialLR(self.optimiser, 0.993)
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(episodes), batch_size=16)

    def learn(self, data: TensorDict, updates: int, length: int) -> dict[str, float]:
        """Adds episodes, and runs updates on windows of a length."""
        self.buffer.extend(data.select("observation", "observed", "action"))
        for _ in range(updates):
            start = torch.randint(data.shape[1] - length + 1, ())
            loss = self.loss(self.buffer.sample()[:, start : start + length])["loss_nll"]
            self.optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.filter.parameters(), 1.0)
            self.optimiser.step()  # the collector's filter is this one
            self.schedule.step()
        error = (data["belief", "mean"] - data["state"])[..., 2].square().mean().sqrt()  # only for the log
        pull, motor = self.filter["transition"].module["transition"].tenths.mul(10).tolist()
        return {"loss_filter": loss.item(), "speed_rmse": error.item(), "pull": pull, "motor": motor}


def make_actor(module: nn.Module, in_keys: list, *before: TensorDictModuleBase) -> ProbabilisticActor:
    """Returns an actor of a Gaussian torque in Nm, which the motor clamps; ``before`` writes the module's input."""
    spread = AddStateIndependentNormalScale(1, init_value=0.7)  # 2 Nm at first
    nn.init.normal_(module[-1].weight, std=0.001)
    head = TensorDictModule(nn.Sequential(module, spread), in_keys, ["loc", "scale"])
    keys = {"in_keys": ["loc", "scale"], "distribution_class": IndependentNormal}
    return ProbabilisticActor(TensorDictSequential(*before, head), **keys, return_log_prob=True)


def ppo(
    make_env: Callable[[int, int], EnvBase],
    actor: TensorDictModule,
    critic: TensorDictModule,
    args: argparse.Namespace,
    slice_length: int = 1,
    lr: float = 1e-3,
    learn: Callable[[TensorDict, int, int], dict[str, float]] | None = None,
) -> float:
    """Trains a policy on batches of whole episodes, in slices of time; returns the mean return of 100 test episodes."""
    gae = GAE(gamma=0.95, lmbda=0.9, value_network=critic, average_gae=True, deactivate_vmap=True)
    loss = ClipPPOLoss(actor, critic, entropy_bonus=False, critic_coeff=0.5, loss_critic_type="l2")
    optimiser = torch.optim.Adam(loss.parameters(), lr=lr)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.05, args.batches)
    logs, curve, rows = RunLogs(args.out, ("csv", "tensorboard") if args.tensorboard else ("csv",)), [], COUNT * STEPS
    logs.open({})
    options = {"frames_per_batch": rows, "total_frames": args.batches * rows, "auto_register_policy_transforms": True}
    collector = Collector(make_env(COUNT, args.seed), actor, **options)
    for number, data in enumerate(bar := tqdm(collector, total=args.batches, desc="PPO", disable=None)):
        curve.append(data["next", "reward"].sum((1, 2)).mean().item())
        values = {"return": curve[-1]}
        if learn is not None:
            values |= learn(data, args.updates, 64) if number else learn(data, 20 * args.updates, 16)
        logs.log(values, step=(number + 1) * rows)
        bar.set_postfix({name: f"{value:.2f}" for name, value in values.items()})
        if learn is not None and number == 0:
            continue  # these beliefs come from an untrained filter
        data["next", "reward"] = 0.1 * data["next", "reward"]
        with torch.no_grad(), set_recurrent_mode(True):
            gae(data)
        slices = data.exclude("next", "state_value").reshape(-1, slice_length)
        for _ in range(10):
            for part in torch.randperm(len(slices)).split(320 // slice_length):
                terms = loss(slices[part])
                optimiser.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        schedule.step()
    collector.shutdown()
    logs.close()
    draw(curve, args.out / "curve.png")
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        test = make_env(100, args.seed + 1)
        return test.rollout(STEPS, actor)["next", "reward"].sum((1, 2)).mean().item()


def draw(curve: list[float], file: Path) -> None:
    """Draws the return of an episode over the environment steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
    axis.plot([(number + 1) * COUNT * STEPS for number in range(len(curve))], curve)
    axis.set(xlabel="environment steps", ylabel="return of an episode")
    figure.savefig(file)


def parse(doc: str, name: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs") / name)
    parser.add_argument("--batches", type=int, default=31, help="3,200 steps each")
    parser.add_argument("--updates", type=int, default=5, help="of a filter, after each batch")
    parser.add_argument("--noise", type=float, default=NOISE, help="of the readings")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tensorboard", action="store_true", help="logs for it, too")
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    args = parser.parse_args()
    if args.smoke:
        args.out, args.batches, args.updates = args.out.with_name(f"{name}-smoke"), 2, 1
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    return args


def main() -> None:
    args = parse(__doc__, "policy")
    learning = LearningFilter(args.batches * COUNT)
    size = {"num_cells": [64, 64], "activation_class": nn.Tanh}

    def make_env(count: int, seed: int) -> EnvBase:
        world = NoisyPendulumEnv(args.noise, batch_size=[count], seed=seed)
        env = TransformedEnv(world, DEnKFTransform(learning.filter, store_ensemble=False))
        units = {"loc": 0.0, "scale": torch.tensor([1.0, 1.0, 1 / NoisyPendulumEnv.MAX_SPEED])}
        return env.append_transform(ObservationNorm(**units, in_keys=[("belief", "mean")], out_keys=["input"]))

    actor, critic = make_actor(MLP(3, 1, **size), ["input"]), ValueOperator(MLP(3, 1, **size), in_keys=["input"])
    print(f"return on the belief: {ppo(make_env, actor, critic, args, learn=learning.learn):.0f}")


if __name__ == "__main__":
    main()
