"""Scores of means and variances of D numbers over the rows that count: all but an episode's first."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.g1.readings import BLACK
from benchmarks.g1.targets import Target
from torch_denkf.functional import crps_gaussian
from torch_denkf.metrics import interval_coverage

FLOOR = 1e-8  # least variance: particles that are all the same have none, and no likelihood
AFTER = 15  # rows after a blackout at which the spread is taken again


def counted(readings: TensorDict) -> Tensor:
    """Rows that count, bool ``[N, T]``."""
    valid = readings["valid"].squeeze(-1).clone()
    valid[:, 0] = False
    return valid


def display(target: Target, values: Tensor) -> Tensor:
    """Degrees of joints, hundredths of a finger's way."""
    return values.rad2deg() if target.name == "arm" else 100 * values


def scores(target: Target, mean: Tensor, var: Tensor, readings: TensorDict) -> dict[str, float]:
    """Mean absolute errors, CRPS of Gaussians and coverage of 90 % intervals, of beliefs ``[N, T, D]``.

    Errors and CRPS are in degrees (hundredths for a hand); the CRPS is a mean over the numbers.
    """
    at = counted(readings)
    mean, var, truth = mean[at], var[at].clamp_min(FLOOR), readings["state"][at]
    error = display(target, (mean - truth).abs().mean(0))
    covered = interval_coverage(mean, var, truth, level=0.9)
    named = {f"n{k + 1}": float(value) for k, value in enumerate(error)}
    covers = {f"cover_n{k + 1}": float(value) for k, value in enumerate(covered)}
    return {
        "joint_mae_deg": float(error.mean()),
        "crps": float(display(target, crps_gaussian(mean, var, truth)).mean()),
        "coverage90": float(covered.mean()),
        **named,
        **covers,
    }


def blackout(target: Target, mean: Tensor, var: Tensor, readings: TensorDict, begin: Tensor) -> dict[str, float]:
    """Error in the black frames, and the mean standard deviation before, at the end of, and after them."""
    rows, steps = torch.arange(len(mean)), mean.shape[1] - 1
    within = (begin.unsqueeze(-1) + torch.arange(BLACK)).clamp(max=steps)
    at = rows.unsqueeze(-1), within
    error = display(target, (mean[at] - readings["state"][at]).abs()).mean()
    std = display(target, var.clamp_min(0).sqrt()).mean(-1)
    times = {"before": begin - 1, "blind": begin + BLACK - 1, "after": begin + BLACK + AFTER}
    spread = {f"std_{name}": float(std[rows, time.clamp(0, steps)].mean()) for name, time in times.items()}
    return {"blackout_mae": float(error), **spread}
