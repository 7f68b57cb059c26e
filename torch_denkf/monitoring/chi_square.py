"""Chi-square distribution of normalised innovations squared: p-values, quantiles, and detectable biases."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torch_denkf._checks import check_number

__all__ = ["chi_square_p_value", "chi_square_quantile", "detectable_bias", "noncentral_p_value"]


def chi_square_p_value(value: Tensor, freedom: float | Tensor) -> Tensor:
    """Returns the probability that a chi-square variable is larger than ``value``.

    Args:
        value: not negative, any shape: for example a normalised innovation squared.
        freedom: degrees of freedom, broadcasts with ``value``. With 0, nothing was observed, and the probability is 1.

    Returns:
        ``[*]`` in [0, 1], differentiable by ``value``.

    Example:
        >>> chi_square_p_value(torch.tensor([3.8415, 0.0]), 1.0).round(decimals=4)
        tensor([0.0500, 1.0000])
    """
    freedom = freedom if isinstance(freedom, Tensor) else value.new_full((), freedom)
    freedom = freedom.to(value).detach()  # torch has no derivative with respect to it
    seen = freedom > 0
    # Unobserved rows get valid arguments, so that neither value nor gradient is NaN.
    tail = torch.special.gammaincc(torch.where(seen, freedom, 1) / 2, torch.where(seen, value, 1).clamp_min(1e-30) / 2)
    return torch.where(seen, tail, 1)


def chi_square_quantile(p_value: float, freedom: float) -> float:
    """Returns the value that a chi-square variable exceeds with probability ``p_value``.

    Raises:
        ValueError: if ``p_value`` is not in (0, 1), or ``freedom`` is not positive.

    Example:
        >>> round(chi_square_quantile(0.05, 1.0), 3)
        3.841
    """
    check_number("p_value", p_value, above=0, below=1)
    check_number("freedom", freedom, above=0)
    return _root(lambda value: p_value - float(chi_square_p_value(_double(value), freedom)))


def noncentral_p_value(value: float, freedom: float, noncentrality: float) -> float:
    """Returns the probability that a non-central chi-square variable is larger than ``value``.

    It is a Poisson mixture of chi-square variables, with two more degrees of freedom for each count.

    Args:
        value: not negative.
        freedom: degrees of freedom, above 0.
        noncentrality: sum of the squared means of the normal numbers.

    Example:
        >>> round(noncentral_p_value(3.841, 1.0, 7.849), 3)  # the textbook's 80 % power at 5 %
        0.8
    """
    check_number("value", value, least=0)
    check_number("freedom", freedom, above=0)
    check_number("noncentrality", noncentrality, least=0)
    middle = noncentrality / 2
    width = 12 * math.sqrt(middle + 1) + 12
    count = torch.arange(max(int(middle - width), 0), int(middle + width) + 1, dtype=torch.float64)
    log_weight = torch.special.xlogy(count, _double(middle)) - middle - (count + 1).lgamma()
    return float((log_weight.exp() * chi_square_p_value(_double(value), freedom + 2 * count)).sum().clamp(max=1))


def detectable_bias(freedom: float, false_alarm_rate: float, *, power: float = 0.9, window: int = 1) -> float:
    """Returns the smallest constant bias of innovations that a windowed chi-square test detects.

    The sum of the normalised innovations squared over ``window`` steps has ``window * freedom`` degrees of freedom; a
    bias b in each makes it non-central by ``window * b^T S^-1 b``.

    Args:
        freedom: observed components O.
        false_alarm_rate: probability that the test rejects an unbiased sensor.
        power: probability of detecting the bias; larger than the false-alarm rate.
        window: steps of the test.

    Returns:
        Norm of the bias in standard deviations of the innovation, the square root of ``b^T S^-1 b``.

    Raises:
        ValueError: for probabilities out of range.

    Example:
        >>> round(detectable_bias(1, 0.05, power=0.8), 3)  # 1.960 + 0.842
        2.802
        >>> detectable_bias(1, 0.001, window=10) < detectable_bias(1, 0.001)
        True
    """
    check_number("power", power, above=false_alarm_rate, below=1)
    total = window * freedom
    threshold = chi_square_quantile(false_alarm_rate, total)
    return math.sqrt(_root(lambda value: noncentral_p_value(threshold, total, value) - power) / window)


def _double(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def _root(rises: Callable[[float], float]) -> float:
    """Finds the positive root of an increasing function."""
    low, high = 0.0, 1.0
    while rises(high) < 0:
        low, high = high, 2 * high
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if rises(middle) < 0 else (low, middle)
    return (low + high) / 2
