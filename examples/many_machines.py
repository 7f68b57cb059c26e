"""Distributed training on one page: workers collect, ranks train a filter and a policy on its belief.

    python examples/many_machines.py                                             # all in this process
    pip install "torch_denkf[ray]" && python examples/many_machines.py --collectors 2
    torchrun --nproc_per_node=2 examples/many_machines.py --collectors 2         # 2 ranks learn, 2 workers collect

The task is to balance dm_control's cartpole from noisy encoders, without measured speeds. Filter and actor are one
policy, so that torchrl's RayCollector sends the filter's new weights to its workers like those of any policy. The
filter learns from the simulator's true state, the policy by torchrl's SAC from the beliefs at collection.

Workers do not wait for each other. While one collects, the ranks go on learning, and its weights become outdated. The
policy has a version number of its weights (``WeightsNumber``), which it writes to every row. Rows whose weights are
more than ``--oldest`` versions behind are counted and dropped. All other rows go into one replay buffer of the first
rank: each rank learns from its part of a sampled batch, and gradients are averaged.

For many machines: ``ray start --head`` on one and ``ray start --address HEAD:6379`` on the others, then ``--address
auto`` and more collectors here. Each worker takes one core and needs this package; it gets the folder ``examples/``
from here. On a busy machine workers start slowly: ray 2.60 waits half a minute for them, or as set by
RAY_agent_register_timeout_ms, and torchrl waits a minute for the first exchange of weights.

In one process, 10 minutes of a core: the reward of a step rises from 0.38 to 0.82, of at most 1. One run.
"""

from __future__ import annotations

import argparse
import importlib.util
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    CatTensors,
    DMControlEnv,
    DoubleToFloat,
    EnvBase,
    InitTracker,
    RewardScaling,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from tqdm import tqdm

from torch_denkf import DEnKF, DEnKFLoss
from torch_denkf.applications.reacher.encoders import NoisyEncoders
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, FromSensor, LearnedTransition, Select, StochasticMLP
from torch_denkf.training import Processes

WINDOW, EPISODE, REPEAT = 25, 100, 4  # steps of a training window, of an episode, of the simulator per step
STD = torch.tensor([0.5, 0.3, 0.3, 1.0, 1.5])  # of the state: place m, cosine, sine of the pole, m/s, rad/s
BELIEF = ("belief", "mean")


class WeightsNumber(TensorDictModuleBase):
    """Writes the version of the weights to each row. It is a buffer, so that it is sent with the weights."""

    def __init__(self):
        super().__init__()
        self.in_keys, self.out_keys = [BELIEF], ["weights_number"]
        self.register_buffer("number", torch.zeros(1, dtype=torch.int64))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("weights_number", self.number.expand(*tensordict.batch_size, 1).clone())


def make_filter() -> DEnKF:
    """Returns a filter of [place, cosine, sine, speed, turn rate]; the encoders read the first three."""
    return DEnKF(
        LearnedTransition(StochasticMLP(5 + 1, 5, (64, 64), output_gain=0.1), scale=STD, action_key="action"),
        None,
        Select([0, 1, 2]),
        ConstantNoise([0.05] * 3, in_key="encoder"),
        EnsembleAnalysis("etkf", observation_key="encoder"),
        initial=FromSensor([0, 1, 2], mean=[0.0] * 5, std=[1.0, 1.0, 1.0, 0.1, 0.1], observation_key="encoder"),
    )


def make_env(denkf: DEnKF, seed: int | None = None) -> EnvBase:
    """Returns the cartpole with noisy encoders and the transforms of a filter in a policy. Runs in the worker."""
    state = CatTensors(in_keys=["position", "velocity"], out_key="state", del_keys=False)
    env = TransformedEnv(DMControlEnv("cartpole", "balance", frame_skip=REPEAT))
    for transform in (DoubleToFloat(), NoisyEncoders(0.05), state, RewardScaling(0.0, 1 / REPEAT)):
        env.append_transform(transform)
    for transform in (StepCounter(EPISODE), InitTracker(), denkf.make_tensordict_primer()):
        env.append_transform(transform)
    env.set_seed(int(torch.randint(2**31, ())) if seed is None else seed)
    return env


def make_policy(denkf: DEnKF) -> tuple[TensorDictSequential, ProbabilisticActor, ValueOperator]:
    """Returns the policy of filter, actor and version of the weights; the actor alone; the critic."""
    head = nn.Sequential(MLP(5, 2, num_cells=[64, 64]), NormalParamExtractor())
    options = {"in_keys": ["loc", "scale"], "distribution_class": TanhNormal, "default_interaction_type": "random"}
    actor = ProbabilisticActor(TensorDictModule(head, [BELIEF], ["loc", "scale"]), **options)
    critic = ValueOperator(MLP(5 + 1, 1, num_cells=[64, 64]), [BELIEF, "action"])
    return TensorDictSequential(denkf, actor, WeightsNumber()), actor, critic


def make_collector(policy: TensorDictSequential, args: argparse.Namespace):
    """Returns a RayCollector, or a collector in this process."""
    total = args.batches * args.frames
    if args.collectors == 0:
        return Collector(partial(make_env, policy[0]), policy, frames_per_batch=args.frames, total_frames=total)
    from torchrl.collectors.distributed import RayCollector

    folder = {"working_dir": str(Path(__file__).parent)}
    collector = RayCollector(
        [partial(make_env, policy[0])] * args.collectors,
        policy,
        frames_per_batch=args.frames,
        total_frames=total,
        sync=False,  # workers do not wait: a batch comes from one worker
        ray_init_config={
            "address": args.address,  # None: starts ray here
            "runtime_env": folder,
            "include_dashboard": False if args.address is None else None,
        },
        remote_configs={"num_cpus": 1, "num_gpus": 0},
    )
    collector.get_distant_attr("total_frames")  # waits until all workers have started
    return collector


def windows(data: TensorDictBase, newest: int, oldest: int) -> tuple[TensorDictBase, TensorDictBase]:
    """Returns the windows ``[N, WINDOW]`` of a batch: those with recent weights, and the others."""
    keys = ("encoder", "action", "state", "is_init", "weights_number", BELIEF)
    rows = data.reshape(-1).select(*keys, ("next", "reward")).reshape(-1, WINDOW)
    age = newest - rows["weights_number"][:, 0, 0]
    if (age < 0).any():
        raise RuntimeError(f"rows of weights {-int(age.min())} versions ahead of the learner's, which is {newest}")
    old = age > oldest
    return rows[~old], rows[old]


def transitions(batch: TensorDictBase) -> TensorDict:
    """Returns rows ``[N]`` for SAC: each with the belief of the next row, except the last of an episode."""
    first, second = batch[:, :-1], batch[:, 1:]
    rows = first.select(BELIEF, "action")
    rows["next"] = second.select(BELIEF).update({"reward": first["next", "reward"]})
    rows["next", "done"] = rows["next", "terminated"] = torch.zeros_like(first["is_init"])  # episodes end by time alone
    return rows[~second["is_init"].squeeze(-1)]


class Learner:
    """Updates filter, actor and critic by all ranks together."""

    def __init__(self, denkf: DEnKF, actor: ProbabilisticActor, critic: ValueOperator, processes: Processes):
        self.filter_loss = DEnKFLoss(denkf, sensor=0.0, transition=0.0, state_scale=STD)
        self.policy_loss = SACLoss(actor, critic, action_spec=make_env(denkf, 0).action_spec, alpha_init=0.02)
        self.policy_loss.make_value_estimator(gamma=0.97)
        self.target = SoftUpdate(self.policy_loss, tau=0.01)
        self.filter_optimiser = torch.optim.Adam(denkf.parameters(), lr=1e-3)
        self.policy_optimiser = torch.optim.Adam(self.policy_loss.parameters(), lr=1e-3)
        self.processes = processes

    def __call__(self, batch: TensorDictBase) -> float:
        """Updates the filter on windows and the policy on their rows; returns the filter's CRPS."""
        crps = self.descend(self.filter_loss(batch.exclude("belief", "next")), self.filter_optimiser)
        rows = transitions(batch)
        for part in torch.randperm(len(rows)).chunk(8):
            self.descend(self.policy_loss(rows[part]), self.policy_optimiser)
            self.target.step()
        return crps

    def descend(self, terms: TensorDictBase, optimiser: torch.optim.Optimizer) -> float:
        """Takes one step of an optimiser with the mean gradient of all ranks; returns the loss."""
        total = sum(value for name, value in terms.items() if name.startswith("loss_"))
        optimiser.zero_grad()
        total.backward()
        parameters = optimiser.param_groups[0]["params"]
        total = self.processes.average_(parameters, total.detach().reshape(1))
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimiser.step()
        return total.item()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--collectors", type=int, default=0, help="workers, by ray; 0: the first rank collects")
    parser.add_argument("--address", help="of a ray cluster, e.g. auto; without it ray starts on this machine")
    parser.add_argument("--frames", type=int, default=1000, help="of a batch (a multiple of 25)")
    parser.add_argument("--batches", type=int, default=60)
    parser.add_argument("--updates", type=int, default=25, help="after each batch")
    parser.add_argument("--oldest", type=int, default=2, help="versions by which a row's weights may be old")
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs; without ray, too")
    args = parser.parse_args()
    if args.smoke:
        args.frames, args.batches, args.updates = 100, 3, 1
    if args.collectors and importlib.util.find_spec("ray") is None:
        raise SystemExit("ray is not installed (pip install ray); without --collectors nothing needs it.")
    if args.frames % WINDOW:
        raise SystemExit(f"--frames must be a multiple of {WINDOW}: whole windows.")
    torch.manual_seed(0)  # all ranks begin with the same weights
    torch.set_num_threads(1)

    processes, denkf = Processes("cpu"), make_filter()
    policy, actor, critic = make_policy(denkf)
    learner, number = Learner(denkf, actor, critic, processes), policy[-1].number
    torch.manual_seed(1 + processes.rank)  # from here on each rank draws for itself
    collector = make_collector(policy, args) if processes.is_main else None
    buffer = ReplayBuffer(storage=LazyTensorStorage(args.batches * args.frames // WINDOW), batch_size=64)
    if processes.is_main:
        collector.update_policy_weights_()  # ray needs it before the first batch, too
        batches = iter(collector)
    ages, refused, rewards = [], 0, []
    try:
        for _ in tqdm(range(args.batches), unit="batch", disable=None if processes.is_main else True):
            if processes.is_main:
                data = next(batches)
                rewards.append(data["next", "reward"].mean())
                fresh, old = windows(data, int(number), args.oldest)
                ages.append(int(number - data["weights_number"].max()))
                refused += len(old) * WINDOW
                if len(fresh):
                    buffer.extend(fresh)
            if processes.any(processes.is_main and len(buffer) == 0):
                continue  # all rows so far were outdated
            for _ in range(args.updates):
                batch = processes.share(buffer.sample() if processes.is_main else None)
                crps = learner(batch.chunk(processes.world_size)[processes.rank])
            number += 1
            if processes.is_main:
                collector.update_policy_weights_()  # to all workers
    finally:
        if processes.is_main:
            collector.shutdown()
    if processes.is_main:
        text = ", ".join(f"{age} versions: {ages.count(age)}" for age in sorted(set(ages)))
        print(f"batches by the age of their weights: {text}; {refused} rows refused")
        tenth = max(1, len(rewards) // 10)
        first, last = (torch.stack(part).mean() for part in (rewards[:tenth], rewards[-tenth:]))
        print(f"CRPS of the belief {crps:.3f} standard deviations")
        print(f"reward of a step {first:.2f} in the first tenth of the batches, {last:.2f} in the last")


if __name__ == "__main__":
    main()
