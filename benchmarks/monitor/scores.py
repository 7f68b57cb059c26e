"""How soon and how surely an alarm tells a fault, and what a gate makes of it."""

from __future__ import annotations

from statistics import median

import torch
from torch import Tensor

__all__ = ["auroc", "before_and_after", "detection", "spans_of"]

AFTER = 10  # steps after a fault in which an alarm is neither right nor wrong


def spans_of(fault: Tensor) -> list[tuple[int, int]]:
    """First step and the one behind the last, of each stretch that is True in ``[T]``."""
    edges = torch.cat([torch.zeros(1), fault.float(), torch.zeros(1)]).diff()
    return list(zip((edges > 0).nonzero().flatten().tolist(), (edges < 0).nonzero().flatten().tolist(), strict=True))


def auroc(score: Tensor, positive: Tensor) -> float:
    """Probability that a positive has the higher score than a negative, ties half; both ``[N]``."""
    hit, other = score[positive].double(), score[~positive].double().sort().values
    below = torch.searchsorted(other, hit, right=False) + torch.searchsorted(other, hit, right=True)
    return float(below.double().mean() / 2 / len(other))


def recovering(fault: Tensor) -> Tensor:
    """Steps of ``[*B, T]`` soon after a fault."""
    soon = torch.zeros_like(fault)
    for steps in range(1, AFTER + 1):
        soon[..., steps:] |= fault[..., :-steps]
    return soon & ~fault


def detection(evidence: Tensor, alarm: Tensor, fault: Tensor) -> dict[str, float]:
    """Scores of runs ``[K, T]`` with faults; the first step, which sees no reading, does not count.

    Returns:
        ``auroc`` of the evidence for "in a fault" against "not"; ``delay_steps``, the median of the steps from a
        fault's first to the first with an alarm, infinite where there is none; ``found``, the share of the faults that
        raise an alarm while they last.
    """
    counts = ~recovering(fault)
    counts[..., 0] = False
    delays = []
    for row_alarm, row_fault in zip(alarm, fault, strict=True):
        for first, end in spans_of(row_fault):
            hits = row_alarm[first:end].nonzero()
            delays.append(float(hits[0]) if len(hits) else float("inf"))
    return {
        "auroc": auroc(evidence[counts], fault[counts]),
        "delay_steps": median(delays),
        "found": sum(delay < float("inf") for delay in delays) / len(delays),
    }


def before_and_after(error: Tensor, fault: Tensor, steps: int = 20) -> Tensor:
    """Errors ``[*K, T]`` of the steps soon after the faults of ``[T]``, but the first two: ``[*K, N]``."""
    parts = [error[..., end + 2 : end + 2 + steps] for _, end in spans_of(fault) if end + 2 < error.shape[-1]]
    return torch.cat(parts, -1)
