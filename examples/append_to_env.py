"""Append a filter to a dm_control arm: reacher's joint velocities from noisy joint positions.

    python examples/append_to_env.py

The encoders of the arm have noise (0.05 rad); the filter does not observe the velocities. The dynamics are
learned, with the action, from a few rollouts; then one line appends the filter to the environment, and a policy could
read ``("belief", "mean")``. The example needs no rendering and no GL library.
The true states are recorded here: docs/how_to/train_motion_first.md shows how to train the motion on them first.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "disabled")  # before dm_control is imported: nothing is rendered here

import torch
from tensordict import TensorDict
from tqdm import tqdm

from torch_denkf import DEnKF, DEnKFLoss, DEnKFTransform
from torch_denkf.applications.reacher.encoders import ENCODER_STD, reacher_env
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, FromSensor, LearnedTransition, Select, StochasticMLP
from torch_denkf.plots import plot_bands

NOISE, DT = ENCODER_STD, 0.02  # encoder noise, 0.05 rad; control step in s


def make_filter(states: torch.Tensor) -> DEnKF:
    """Returns a filter of [q1, q2, w1, w2] in rad and rad/s; learned dynamics, known observation of the positions."""
    loc, scale = states.mean(0), states.std(0)
    return DEnKF(
        transition=LearnedTransition(
            StochasticMLP(4 + 2, 4, (64, 64), output_gain=0.1), loc=loc, scale=scale, action_key="action"
        ),
        sensor=None,  # the encoders are read directly
        observation=Select([0, 1]),
        noise=ConstantNoise([NOISE, NOISE], in_key="encoder"),
        analysis=EnsembleAnalysis(
            "etkf", observation_key="encoder"
        ),  # deterministic: draws no perturbations of the reading
        initial=FromSensor([0, 1], mean=[0.0] * 4, std=[1.0, 1.0, 0.5, 0.5], observation_key="encoder"),
    )


def train(denkf: DEnKF, rollouts: TensorDict, updates: int, length: int) -> None:
    """Fits the transition through ``length`` steps of random windows."""
    loss = DEnKFLoss(denkf, sensor=0.0, transition=0.0, state_scale=denkf["transition"].scale)
    optimiser = torch.optim.Adam(denkf.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=updates)
    data = rollouts.select("state", "encoder", "action")
    for _ in (bar := tqdm(range(updates), desc="training", disable=None)):
        rows = torch.randint(data.shape[0], (64,))
        starts = torch.randint(data.shape[1] - length + 1, (64, 1)) + torch.arange(length)
        total = sum(loss(data[rows[:, None], starts]).values())
        optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(denkf.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        bar.set_postfix(crps=f"{total.item():.4f}")


def compare(rollout: TensorDict) -> str:
    """Compares the filter's velocities with differences of the encoders, raw and smoothed over eleven steps."""
    truth, encoder = rollout["next", "state"], rollout["next", "encoder"]
    raw = encoder.diff(dim=0, prepend=encoder[:1]) / DT
    smooth = torch.stack([raw[max(0, t - 10) : t + 1].mean(0) for t in range(len(raw))])
    mean, var = rollout["next", "belief", "mean"], rollout["next", "belief", "var"]
    lines = ["| | positions, RMSE rad | velocities, RMSE rad/s |", "|---|---|---|"]
    for name, position, velocity in (
        ("encoders and their differences", encoder, raw),
        ("mean of the last eleven differences", encoder, smooth),
        ("**DEnKF**", mean[:, :2], mean[:, 2:]),
    ):
        errors = [(a - b).square().mean().sqrt() for a, b in ((position, truth[:, :2]), (velocity, truth[:, 2:]))]
        lines.append(f"| {name} | {errors[0]:.4f} | {errors[1]:.3f} |")
    inside = interval_coverage(mean, var, truth, level=0.9).mean()
    return "\n".join(lines) + f"\n\n90 % intervals of the belief hold {100 * inside:.0f} % of the truth."


def draw(rollout: TensorDict, file: Path) -> None:
    """Draws the joint velocities over time, next to differences of the encoders."""
    seen = rollout["next"]
    differences = seen["encoder"].diff(dim=0, prepend=seen["encoder"][:1]) / DT
    names, dots = ["joint 1, rad/s", "joint 2, rad/s"], {dim: differences[:, dim - 2] for dim in (2, 3)}
    axes = plot_bands(seen, dims=[2, 3], names=names, readings=dots, time=DT)
    for axis in axes:
        axis.set_ylim(-12, 12)
    axes[0].figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=30, help="rollouts of 200 steps to train on")
    parser.add_argument("--updates", type=int, default=400, help="training steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/append_to_env"))
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    args = parser.parse_args()
    if args.smoke:
        args.episodes, args.updates, args.out = 2, 3, args.out / "smoke"
    torch.manual_seed(args.seed)
    args.out.mkdir(parents=True, exist_ok=True)

    env = reacher_env(args.seed)
    rollouts = torch.stack([env.rollout(200) for _ in tqdm(range(args.episodes), desc="collecting", disable=None)])
    denkf = make_filter(rollouts["state"].flatten(0, 1))
    train(denkf, rollouts, args.updates, length=25)

    env = reacher_env(args.seed + 1000)
    env.append_transform(DEnKFTransform(denkf))
    rollout = env.rollout(400)
    table = compare(rollout)
    (args.out / "table.md").write_text(table + "\n")
    draw(rollout, args.out / "velocities.png")
    print(
        f"\nUnseen episode of reacher, encoder noise {NOISE} rad:\n\n{table}\n\nPicture: {args.out / 'velocities.png'}"
    )


if __name__ == "__main__":
    main()
