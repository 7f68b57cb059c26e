"""Trains the filter ``reacher``: its transition, on episodes of random actions; a minute on one core."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from torch_denkf.applications.reacher.encoders import ENCODER_STD, reacher_env
from torch_denkf.applications.reacher.filter import ReacherFilter, reacher
from torch_denkf.deployment.progress import progress_bar
from torch_denkf.metrics import interval_coverage
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.pretrained.folders import save_pretrained
from torch_denkf.training import FilterTrainer, Stage

__all__ = ["evaluate_reacher", "train_reacher"]

_DT = 0.02  # s
_LENGTH = 25  # steps of a window


def train_reacher(
    out: Path, *, seed: int = 0, updates: int = 400, episodes: int = 30, command: str = "", progress: bool = True
) -> ReacherFilter:
    """Trains the filter and writes it to a folder.

    Args:
        out: folder of the filter, with its logs below ``training``.
        seed: of all random numbers.
        updates: number of updates of the transition.
        episodes: number of training episodes of 200 steps.
        command: command line, as a record.
        progress: whether to show progress bars.
    """
    torch.manual_seed(seed)
    env = reacher_env(seed)
    with progress_bar("episodes", episodes, shown=progress) as bar:
        rollouts = []
        for _ in range(episodes):
            rollouts.append(env.rollout(200).select("state", "encoder", "action"))
            bar.update()
    data = TensorDict.stack(rollouts)
    states = data["state"].flatten(0, 1)
    model = reacher(
        encoder_std=ENCODER_STD, state_mean=tuple(states.mean(0).tolist()), state_std=tuple(states.std(0).tolist())
    )

    def sample(generator: torch.Generator, _):
        rows = torch.randint(data.shape[0], (64, 1), generator=generator)
        starts = torch.randint(data.shape[1] - _LENGTH + 1, (64, 1), generator=generator)
        return data[rows, starts + torch.arange(_LENGTH)]

    loss = DEnKFLoss(model, sensor=0.0, transition=0.0, state_scale=torch.tensor(model.settings.state_std))
    stage = Stage("filter", loss, sample, updates, lr=3e-3)
    FilterTrainer(model, [stage], out=out / "training", seed=seed, device="cpu", progress=progress).fit()
    record = {"command": command, "seed": seed, "episodes": episodes, "updates": updates}
    save_pretrained(model, out, training=record)
    return model.eval()


@torch.no_grad()
def evaluate_reacher(model: ReacherFilter, *, episodes: int = 10, steps: int = 400, seed: int = 1000) -> dict[str, Any]:
    """Returns errors on held-out episodes.

    Returns:
        Root mean square errors in rad and rad/s of the filter, of the encoders, their differences, and the mean of the
        last eleven differences; and the coverage of the filter's 90 % intervals.
    """
    torch.manual_seed(seed)
    env = reacher_env(seed)
    data = TensorDict.stack([env.rollout(steps).select("state", "encoder", "action") for _ in range(episodes)])
    belief = model.sequence(data.clone())["belief"]
    mean, var, truth, encoder = belief["mean"][:, 1:], belief["var"][:, 1:], data["state"][:, 1:], data["encoder"]
    raw = encoder.diff(dim=1) / _DT
    smooth = torch.stack([raw[:, max(0, t - 10) : t + 1].mean(1) for t in range(raw.shape[1])], 1)

    def rmse(estimate, dims):
        return float((estimate - truth[..., dims]).square().mean().sqrt())

    angles, rates = slice(0, 2), slice(2, 4)
    covered = interval_coverage(mean.flatten(0, 1), var.flatten(0, 1), truth.flatten(0, 1), level=0.9)
    return {
        "angles, RMSE rad": {"filter": rmse(mean[..., angles], angles), "encoders": rmse(encoder[:, 1:], angles)},
        "rates, RMSE rad/s": {
            "filter": rmse(mean[..., rates], rates),
            "differences": rmse(raw, rates),
            "mean of the last eleven differences": rmse(smooth, rates),
        },
        "held by 90 % intervals": float(covered.mean()),
    }
