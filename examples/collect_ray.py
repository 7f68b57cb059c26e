"""Learn a filter while several processes, or machines, collect for it: torchrl's RayCollector.

    pip install "torch_denkf[ray]" && python examples/collect_ray.py --collectors 2    # processes on this machine
    python examples/collect_ray.py                                                     # no ray: in this process

The arm is that of append_to_env.py: reacher with noisy encoders and hidden joint velocities. Filter and actor are one
policy, so that the collector sends the filter's new weights to all of its workers like any policy's.

For many machines: ``ray start --head`` on one and ``ray start --address HEAD:6379`` on the others, then
``--address auto --collectors N`` here. Each collector takes one core (``remote_configs``); the workers need this
package installed, and get the folder ``examples/`` from here (``working_dir``). ``--smoke``, which CI runs, goes
without ray where it is not installed. (ray 2.60 gives up where its agents take more than half a minute to start, as
they do where all cores are busy: RAY_agent_register_timeout_ms=200000 lets it wait.)

Velocities that the filter believes while it collects, RMSE of the first and of the thirtieth batch: 24.1 and 0.30 rad/s
with two collectors of ray 2.60 (2 min on two cores), 19.6 and 0.29 rad/s without ray.
"""

from __future__ import annotations

import argparse
import importlib.util
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase, InitTracker, StepCounter
from tqdm import tqdm

from torch_denkf import DEnKF, DEnKFLoss
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, FromSensor, LearnedTransition, Select, StochasticMLP
from torch_denkf.pretrained.encoders import ENCODER_STD, reacher_env

WINDOW = 25  # steps that are back-propagated through
EPISODE = 200  # steps; a filter that has learned little goes astray in long ones


def make_filter(states: torch.Tensor) -> DEnKF:
    """State [q1, q2, w1, w2] in rad and rad/s, as in append_to_env.py."""
    loc, scale = states.mean(0), states.std(0)
    return DEnKF(
        LearnedTransition(
            StochasticMLP(4 + 2, 4, (64, 64), output_gain=0.1), loc=loc, scale=scale, action_key="action"
        ),
        None,
        Select([0, 1]),
        ConstantNoise([ENCODER_STD, ENCODER_STD], in_key="encoder"),
        EnsembleAnalysis("etkf", sensor_key="encoder"),
        initial=FromSensor([0, 1], mean=[0.0] * 4, std=[1.0, 1.0, 0.5, 0.5], sensor_key="encoder"),
    )


def policy_env(denkf: DEnKF) -> EnvBase:
    """Reacher as the policy needs it: a mark at resets, and what the filter remembers. Runs in the worker."""
    env = reacher_env(int(torch.randint(2**31, ())))
    for transform in (StepCounter(EPISODE), InitTracker(), denkf.make_tensordict_primer()):
        env.append_transform(transform)
    return env


def act(mean: torch.Tensor) -> torch.Tensor:
    """Torques ``[*B, 2]`` against the believed velocities, and at random: the arm is to move, but not to spin."""
    return (0.8 * torch.randn_like(mean[..., 2:]) - 0.1 * mean[..., 2:]).clamp(-1, 1)


def make_collector(denkf: DEnKF, args: argparse.Namespace):
    """A RayCollector where ray is installed, else the same in this process; and how many collect."""
    policy = TensorDictSequential(denkf, TensorDictModule(act, in_keys=[("belief", "mean")], out_keys=["action"]))
    create, total = partial(policy_env, denkf), args.iterations * args.frames
    if args.collectors == 1:
        return Collector(create, policy, frames_per_batch=args.frames, total_frames=total), 1
    from torchrl.collectors.distributed import RayCollector

    collector = RayCollector(
        [create] * args.collectors,
        policy,
        frames_per_batch=args.frames,
        total_frames=total,
        sync=True,  # a batch has the same number of frames of each
        ray_init_config={
            "address": args.address,  # None: starts ray here
            "runtime_env": {"working_dir": str(Path(__file__).parent)},
            "include_dashboard": False if args.address is None else None,
        },
        remote_configs={"num_cpus": 1, "num_gpus": 0},
    )
    return collector, args.collectors


def windows(data: TensorDictBase) -> TensorDict:
    """Rows of one collector after the other, cut into ``[N, WINDOW]``; a reset inside of a window is marked there."""
    return data.reshape(-1).select("encoder", "action", "state", "is_init").reshape(-1, WINDOW)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--collectors", type=int, default=1, help="more than one: processes or machines, by ray")
    parser.add_argument("--address", help="of a ray cluster, e.g. auto; without it ray starts on this machine")
    parser.add_argument("--frames", type=int, default=2000, help="a batch, over all collectors (multiple of 25 each)")
    parser.add_argument("--iterations", type=int, default=30, help="batches")
    parser.add_argument("--updates", type=int, default=20, help="updates after each batch")
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs; without ray, too")
    args = parser.parse_args()
    if args.smoke:
        args.frames, args.iterations, args.updates = 200, 2, 1
        args.collectors = max(args.collectors, 2)
    if args.collectors > 1 and importlib.util.find_spec("ray") is None:
        message = "ray is not installed (pip install ray)"
        if not args.smoke:
            raise SystemExit(f"{message}; without --collectors one collector runs in this process.")
        print(f"{message}: one collector in this process instead.")
        args.collectors = 1
    if args.frames % (WINDOW * args.collectors):
        raise SystemExit(f"--frames must be a multiple of {WINDOW * args.collectors}: whole windows of each collector.")
    torch.manual_seed(0)

    env = reacher_env(0)
    denkf = make_filter(env.rollout(200)["state"])  # its scales
    loss = DEnKFLoss(denkf, sensor=0.0, transition=0.0, state_scale=denkf["transition"].scale)
    optimiser = torch.optim.Adam(denkf.parameters(), lr=2e-3)
    collector, count = make_collector(denkf, args)
    print(f"{count} collector(s), {args.frames} frames a batch")
    buffer = ReplayBuffer(storage=LazyTensorStorage(args.iterations * args.frames // WINDOW), batch_size=64)
    errors = []
    collector.update_policy_weights_()  # ray's wants it before the first batch, too
    try:
        for data in (bar := tqdm(collector, total=args.iterations, unit="batch", disable=None)):
            buffer.extend(windows(data))
            for _ in range(args.updates):
                total = sum(loss(buffer.sample()).values())
                optimiser.zero_grad()
                total.backward()
                torch.nn.utils.clip_grad_norm_(denkf.parameters(), 1.0)
                optimiser.step()
            collector.update_policy_weights_()  # to every worker, wherever it is
            errors.append((data["belief", "mean"] - data["state"])[..., 2:].square().mean().sqrt())
            text = f"crps {total.item():.4f}, velocities while collecting: RMSE {errors[-1]:.3f} rad/s"
            bar.set_postfix_str(text)
    finally:
        collector.shutdown()
    print(f"{text} (first batch: {errors[0]:.3f})")


if __name__ == "__main__":
    main()
