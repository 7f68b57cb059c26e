"""Scores of a monitor's alarms, and errors after a fault."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor

AFTER = 10  # steps after a fault in which alarms are not scored, and errors may settle


class Run(NamedTuple):
    """Output of a monitor on one run; all ``[T]``.

    Attributes:
        evidence: in units of its limit.
        alarm: bool.
        fault: bool: whether the step has a faulty reading.
    """

    evidence: Tensor
    alarm: Tensor
    fault: Tensor


def spans_of(fault: Tensor) -> list[tuple[int, int]]:
    """Returns first step and end (exclusive) of each stretch of True in ``[T]``."""
    edges = torch.cat([torch.zeros(1), fault.float(), torch.zeros(1)]).diff()
    return list(zip((edges > 0).nonzero().flatten().tolist(), (edges < 0).nonzero().flatten().tolist(), strict=True))


def auroc(score: Tensor, positive: Tensor) -> float:
    """Returns the probability that a positive's score is above a negative's; ties count half; both ``[N]``."""
    hit, other = score[positive].double(), score[~positive].double().sort().values
    below = torch.searchsorted(other, hit, right=False) + torch.searchsorted(other, hit, right=True)
    return float(below.double().mean() / 2 / len(other))


def detection(runs: Sequence[Run]) -> dict[str, float]:
    """Returns scores of runs with faults.

    The first step, which has no reading, and the ten steps after a fault are not scored.

    Returns:
        ``auroc`` of the evidence for steps with a fault; ``delay_steps``, the median of the steps from a fault's first
        step to its first alarm, infinite without one; ``found``, the share of the faults that raise an alarm while they
        last.
    """
    scores, labels, delays = [], [], []
    for run in runs:
        counts = torch.ones_like(run.fault)
        counts[0] = False
        for first, end in spans_of(run.fault):
            counts[end : end + AFTER] = False
            hits = run.alarm[first:end].nonzero()
            delays.append(float(hits[0]) if len(hits) else float("inf"))
        counts |= run.fault
        scores.append(run.evidence[counts])
        labels.append(run.fault[counts])
    found = sum(delay < float("inf") for delay in delays) / len(delays)
    return {"auroc": auroc(torch.cat(scores), torch.cat(labels)), "delay_steps": median(delays), "found": found}


def false_alarms(runs: Sequence[Run]) -> dict[str, float]:
    """Returns the alarms raised, and the steps under an alarm, in 1,000 steps of runs without a fault."""
    alarms = [run.alarm[1:] for run in runs]
    steps = sum(len(alarm) for alarm in alarms)
    raised = sum(len(spans_of(alarm)) for alarm in alarms)
    on = sum(int(alarm.sum()) for alarm in alarms)
    return {"false_alarms_per_1000": 1000 * raised / steps, "false_steps_per_1000": 1000 * on / steps}


def afterwards(error: Tensor, fault: Tensor, steps: int = 20) -> Tensor:
    """Selects errors ``[*K, N]`` of ``[*K, T]`` in ``steps`` steps, from ten steps after each fault of ``[T]`` on."""
    return torch.cat([error[..., end + AFTER : end + AFTER + steps] for _, end in spans_of(fault)], -1)
