"""Scores of means and variances of D numbers over the rows that count: all but an episode's first."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.g1.readings import BLACK
from benchmarks.g1.recordings import NAMES
from torch_denkf.functional import crps_gaussian
from torch_denkf.metrics import interval_coverage

FLOOR = 1e-8  # least variance: particles that are all the same have none, and no likelihood
AFTER = 15  # rows after a blackout at which the spread is taken again


def counted(readings: TensorDict) -> Tensor:
    """Rows that count, bool ``[N, T]``."""
    valid = readings["valid"].squeeze(-1).clone()
    valid[:, 0] = False
    return valid


def scores(mean: Tensor, var: Tensor, readings: TensorDict) -> dict[str, float]:
    """Mean absolute errors and CRPS of Gaussians in degrees, and coverage of 90 % intervals, of ``[N, T, 7]``."""
    at = counted(readings)
    mean, var, truth = mean[at], var[at].clamp_min(FLOOR), readings["state"][at]
    error = (mean - truth).abs().mean(0).rad2deg()
    covered = interval_coverage(mean, var, truth, level=0.9)
    return {
        "joint_mae_deg": float(error.mean()),
        "crps": float(crps_gaussian(mean, var, truth).mean().rad2deg()),
        "coverage90": float(covered.mean()),
        **{f"{name}_deg": float(value) for name, value in zip(NAMES, error, strict=True)},
        **{f"{name}_coverage90": float(value) for name, value in zip(NAMES, covered, strict=True)},
    }


def blackout(mean: Tensor, var: Tensor, readings: TensorDict, begin: Tensor) -> dict[str, float]:
    """Error in the black frames, and the mean standard deviation before, at the end of, and after them."""
    rows, steps = torch.arange(len(mean)), mean.shape[1] - 1
    within = (begin.unsqueeze(-1) + torch.arange(BLACK)).clamp(max=steps)
    at = rows.unsqueeze(-1), within
    error = (mean[at] - readings["state"][at]).abs().mean().rad2deg()
    std = var.clamp_min(0).sqrt().mean(-1).rad2deg()
    times = {"before": begin - 1, "blind": begin + BLACK - 1, "after": begin + BLACK + AFTER}
    spread = {f"std_{name}": float(std[rows, time.clamp(0, steps)].mean()) for name, time in times.items()}
    return {"blackout_mae": float(error), **spread}
