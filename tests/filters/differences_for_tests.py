"""Derivatives without a gradient."""

from collections.abc import Callable

import torch


def central_difference(value: Callable[[], torch.Tensor], parameter: torch.Tensor, entry: int, step: float = 1e-6):
    """Derivative of ``value()`` by one entry of a contiguous parameter, which is put back."""
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            parameter.view(-1)[entry] += sign * step
            values.append(value())
            parameter.view(-1)[entry] -= sign * step
    return (values[0] - values[1]) / (2 * step)
