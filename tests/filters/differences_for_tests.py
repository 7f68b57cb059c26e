"""Derivatives without a gradient, and gradients that agree with them."""

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


def check_largest_gradients(modules, value: Callable[[], torch.Tensor], *, rtol: float, atol: float) -> int:
    """Compares the gradients of ``value()``, which are there, with differences; returns how many there were.

    Of each parameter that has a gradient the entry with the largest one is compared.
    """
    checked = 0
    for module in modules:
        for parameter in module.parameters():
            if parameter.grad is None or not parameter.grad.any():
                continue
            entry = int(parameter.grad.abs().argmax())
            difference = central_difference(value, parameter, entry)
            torch.testing.assert_close(parameter.grad.view(-1)[entry], difference, rtol=rtol, atol=atol)
            checked += 1
    return checked
