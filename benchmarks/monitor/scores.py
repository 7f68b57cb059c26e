"""Tells how soon and how surely an alarm tells a fault, and what a gate makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor

AFTER = 10  # steps after a fault in which an alarm is neither right nor wrong, and an error may settle


class Run(NamedTuple):
    """Holds what a monitor said of one run; all ``[T]``.

    Attributes:
        evidence: of which 1 is the limit.
        alarm: bool.
        fault: bool: whether the reading of the step is of a fault.
    """

    evidence: Tensor
    alarm: Tensor
    fault: Tensor


def spans_of(fault: Tensor) -> list[tuple[int, int]]:
    """First step and the one behind the last, of each stretch that is True in ``[T]``."""
    edges = torch.cat([torch.zeros(1), fault.float(), torch.zeros(1)]).diff()
    return list(zip((edges > 0).nonzero().flatten().tolist(), (edges < 0).nonzero().flatten().tolist(), strict=True))


def auroc(score: Tensor, positive: Tensor) -> float:
    """Probability that a positive has the higher score than a negative, ties half; both ``[N]``."""
    hit, other = score[positive].double(), score[~positive].double().sort().values
    below = torch.searchsorted(other, hit, right=False) + torch.searchsorted(other, hit, right=True)
    return float(below.double().mean() / 2 / len(other))


def detection(runs: Sequence[Run]) -> dict[str, float]:
    """Returns scores of runs with faults.

    Neither the first step, which sees no reading, nor the ten steps after a fault count.

    Returns:
        ``auroc`` of the evidence for "in a fault" against "not"; ``delay_steps``, the median of the steps from a
        fault's first to the first with an alarm, infinite if there is none; ``found``, the share of the faults that
        raise an alarm while they last.
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
    """Of runs without a fault, in 1,000 steps: alarms that are raised, and steps at which one is on."""
    alarms = [run.alarm[1:] for run in runs]
    steps = sum(len(alarm) for alarm in alarms)
    raised = sum(len(spans_of(alarm)) for alarm in alarms)
    on = sum(int(alarm.sum()) for alarm in alarms)
    return {"false_alarms_per_1000": 1000 * raised / steps, "false_steps_per_1000": 1000 * on / steps}


def afterwards(error: Tensor, fault: Tensor, steps: int = 20) -> Tensor:
    """Of errors ``[*K, T]`` those of ``steps`` steps, from ten after each fault of ``[T]`` on: ``[*K, N]``."""
    return torch.cat([error[..., end + AFTER : end + AFTER + steps] for _, end in spans_of(fault)], -1)
