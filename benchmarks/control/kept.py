"""PPO with a filter in the policy: the noise of the collection kept with the data, or drawn anew in each update.

``python -m benchmarks.control.kept --seeds 2``. The mass on a spring of docs/how_to/policies.md. The filter has few
members and random draws, which matter: with exact ones and a linear motion its mean hardly depends on them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator, set_recurrent_mode
from torchrl.modules.utils import get_env_transforms_from_module
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from torch_denkf import DEnKF, LinearGaussianEnv
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedTransition,
    NoisyTransition,
    Select,
)

MEAN = ("belief", "mean")


@dataclass(frozen=True)
class Kept:
    """Options of the study of kept noise."""

    seeds: int = 2
    rounds: int = 25
    members: int = 8
    episodes: int = 1000  # of the test
    page: Path | None = None  # where to leave the table


def make_filter(members: int, keep: bool) -> DEnKF:
    """The page's filter with random draws: it knows the spring, and nothing of the motor."""
    motion = nn.Linear(3, 2, bias=False)
    motion.weight.data = torch.tensor([[1.0, 0.1, 0.0], [-0.1, 0.98, 0.0]])
    q = ConstantNoise([0.0, 0.1], in_key=MEAN, out_key=("forecast", "noise"))
    return DEnKF(
        NoisyTransition(LearnedTransition(motion, residual=False, action_key="action"), q, draws="random"),
        None,
        Select([0]),
        ConstantNoise([0.3], in_key="observation"),
        EnsembleAnalysis("perturbed", observation_key="observation", draws="random"),
        initial=GaussianPrior([0.0, 0.0], [1.0, 0.5], ensemble_size=members, draws="random"),
        keep_noise=keep,
    )


def play(policy: nn.Module, count: int, seed: int, how: ExplorationType) -> TensorDict:
    """Episodes ``[B, 50]``."""
    stds = {"transition_std": [0.0, 0.1], "observation_std": [0.3], "initial_std": [1.0, 0.5]}
    motor, reads = torch.tensor([[0.0], [0.2]]), torch.tensor([[1.0, 0.0]])
    spring = torch.tensor([[1.0, 0.1], [-0.1, 0.98]])
    world = LinearGaussianEnv(spring, reads, **stds, control=motor, max_steps=50, batch_size=[count], seed=seed)
    with torch.no_grad(), set_exploration_type(how):
        data = TransformedEnv(world, get_env_transforms_from_module(policy)).rollout(50, policy)
    cost = data["next", "state"][..., :1].square() + 0.1 * data["action"].square()
    return data.set(("next", "reward"), -cost / 10)


def run(study: Kept, keep: bool, seed: int) -> list[str]:
    """Cells: log-ratio before the first update, share clipped in all, return, bytes of noise in a step, seconds."""
    torch.manual_seed(seed)
    begun, filter = time.process_time(), make_filter(study.members, keep)
    size = {"num_cells": [64, 64], "activation_class": nn.Tanh}
    network = nn.Sequential(MLP(2, 2, **size), NormalParamExtractor(scale_lb=1e-3))
    actor = ProbabilisticActor(
        TensorDictModule(network, [MEAN], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    policy = ProbabilisticTensorDictSequential(filter, *actor)
    critic = ValueOperator(MLP(2, 1, **size), in_keys=[MEAN])
    gae = GAE(gamma=0.95, lmbda=0.9, value_network=critic, shifted=True, deactivate_vmap=True)
    settings = {"entropy_bonus": False, "critic_coeff": 0.5, "loss_critic_type": "l2", "normalize_advantage": True}
    loss = ClipPPOLoss(policy, critic, **settings)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.05, study.rounds)
    spread, clipped, noise = None, [], 0
    for number in range(study.rounds):
        data = play(policy, 32, 1000 * seed + number, ExplorationType.RANDOM)
        noise = data["drawn"].bytes() // data.numel() if "drawn" in data.keys() else 0  # noqa: SIM118 - a tensordict
        with torch.no_grad(), set_recurrent_mode(True):
            gae(data)
            if spread is None:
                chosen = policy.get_dist(data.copy()).log_prob(data["action"])
                spread = (chosen - data["action_log_prob"]).std().item()
        slices = data.reshape(-1, 25)
        for _ in range(5):
            for rows in torch.randperm(64).split(16):
                terms = loss(slices[rows])
                optimiser.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
                clipped.append(terms["clip_fraction"].item())
        schedule.step()
    seconds = time.process_time() - begun
    reward = play(policy, study.episodes, 1000, ExplorationType.DETERMINISTIC)["next", "reward"]
    share = sum(clipped) / len(clipped)
    returned = 10 * reward.sum((1, 2)).mean().item()
    return [f"{spread:.1e}", f"{100 * share:.1f} %", f"{returned:.1f}", noise, f"{seconds:.0f}"]


def main() -> None:
    """Writes the table."""
    study = parse(Kept)
    lines = head("noise", "seed", "log-ratio before an update", "clipped", "return", "bytes a step", "s of one core")
    for seed in range(study.seeds):
        for keep in (True, False):
            lines.append(line("kept" if keep else "drawn anew", seed, *run(study, keep, seed)))
            print(lines[-1], flush=True)
    write_page("\n".join([*lines, "", *made_by("control.kept"), ""]), study.page)


if __name__ == "__main__":
    main()
