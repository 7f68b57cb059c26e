"""Change detection in a stream of scores: cumulative sums (CUSUM) and their run lengths."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_number

__all__ = ["cusum_run_length", "cusum_step", "cusum_threshold", "normal_score"]

_STATES = 400  # states of the Markov chain that approximates a cumulative sum
_LONGEST = 20.0  # largest threshold in the search


def normal_score(p_value: Tensor, largest: float = 4.0) -> Tensor:
    """Returns the standard normal number that is exceeded with probability ``p_value``.

    Args:
        p_value: in [0, 1], any shape.
        largest: the score is clamped to [-largest, largest], so that no single reading decides.

    Example:
        >>> normal_score(torch.tensor([0.1587, 0.0228, 0.0])).round(decimals=2)
        tensor([1., 2., 4.])
    """
    # p is clamped first, as the slope beyond the bounds may be infinite.
    least = float(torch.special.ndtr(torch.tensor(-largest, dtype=torch.float64)))
    return -torch.special.ndtri(p_value.clamp(least, 1 - least))


def cusum_step(total: Tensor, score: Tensor, reference: float) -> Tensor:
    """Runs one step of a one-sided cumulative sum, ``max(0, total + score - reference)`` (Page 1954).

    Args:
        total: cumulative sum of the steps before, any shape; initially 0.
        score: standard normal without a change.
        reference: half of the shift of the score that is detected fastest.

    Example:
        >>> cusum_step(torch.tensor(1.0), torch.tensor(2.0), 0.5)
        tensor(2.5000)
    """
    return (total + score - reference).clamp_min(0)


def cusum_run_length(threshold: float, reference: float = 0.5, shift: float = 0.0) -> float:
    """Returns the average run length until a one-sided cumulative sum of N(shift, 1) scores exceeds its threshold.

    The sum is approximated by a Markov chain on a fine grid (Brook & Evans 1972, Biometrika 59).

    Args:
        threshold: threshold of the sum.
        reference: see :func:`cusum_step`.
        shift: mean of the scores; 0 for the average steps between false alarms.

    Example:
        >>> round(cusum_run_length(4.0) / 2), round(cusum_run_length(4.0, shift=1.0), 2)  # two-sided, one-sided
        (168, 8.38)
    """
    check_number("threshold", threshold, above=0)
    width = 2 * threshold / (2 * _STATES - 1)
    place = torch.arange(_STATES, dtype=torch.float64) * width
    edges = place + width / 2  # the first state includes all sums that are clamped to zero
    below = torch.special.ndtr(edges - place.unsqueeze(-1) + reference - shift)
    chance = torch.cat([below[:, :1], below.diff(dim=-1)], -1)
    system = torch.eye(_STATES, dtype=torch.float64) - chance
    return float(torch.linalg.solve(system, torch.ones(_STATES, dtype=torch.float64))[0])


def cusum_threshold(run_length: float, reference: float = 0.5) -> float:
    """Returns the threshold for an average of ``run_length`` steps between false alarms of a cumulative sum.

    Raises:
        ValueError: if ``run_length`` is not larger than 2, or needs a threshold above 20.

    Example:
        >>> round(cusum_threshold(930.0), 1)
        5.0
    """
    check_number("run_length", run_length, above=2)
    low, high = 0.0, 0.5
    while cusum_run_length(high, reference) < run_length:
        low, high = high, 2 * high
        if high > _LONGEST:
            raise ValueError(f"run_length {run_length:g} needs a threshold above {_LONGEST:g}; raise the reference")
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if cusum_run_length(middle, reference) < run_length else (low, middle)
    return (low + high) / 2
