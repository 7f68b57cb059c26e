"""Angles in radians, of which many values mean the same direction."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def check_angles(angles: Sequence[int], size: int) -> None:
    """Raises unless all angles are components of ``size``.

    Raises:
        ValueError: if one is not.
    """
    strange = [index for index in angles if not -size <= index < size]
    if strange:
        raise ValueError(f"angles are components of {size}, 0 to {size - 1}; got {strange} in {list(angles)}")


def wrap_angles(values: Tensor, angles: Sequence[int] | None = None) -> Tensor:
    """Brings angles to [-pi, pi).

    Args:
        values: ``[*, N]``, or of any shape if all are angles.
        angles: the components that are angles in radians; ``None`` for all, none if empty.

    Returns:
        The same directions, of the same shape.

    Raises:
        ValueError: if one of ``angles`` is no component.

    Examples:
        >>> wrap_angles(torch.tensor([0.5, 4.0, -4.0]))
        tensor([ 0.5000, -2.2832,  2.2832])
        >>> wrap_angles(torch.tensor([6.0, 6.0]), [1])
        tensor([ 6.0000, -0.2832])
    """
    if angles is not None and not len(angles):
        return values
    wrapped = torch.remainder(values + math.pi, 2 * math.pi) - math.pi
    if angles is None:
        return wrapped
    check_angles(angles, values.shape[-1])
    is_angle = torch.zeros(values.shape[-1], dtype=torch.bool, device=values.device)
    is_angle[list(angles)] = True
    return torch.where(is_angle, wrapped, values)


def align_angles(
    predicted: Tensor, observation: Tensor, angles: Sequence[int], observed: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Brings angles to the same turn, so that they can be averaged and subtracted like other numbers.

    Predictions go within half a turn of their circular mean, the observation's samples within half a turn of their own,
    and that within half a turn of the predictions'. What is no angle stays as it is.

    Args:
        predicted: predicted observations of the members, ``[*B, E, O]``.
        observation: samples ``[*B, E, O]`` or one reading ``[*B, O]``.
        angles: the components that are angles in radians.
        observed: optional mask ``[*B, 1]`` or ``[*B, O]``; what it hides may be NaN, and becomes 0.

    Returns:
        Both, of the same shapes.

    Examples:
        >>> predicted, reading = align_angles(torch.tensor([[3.1], [-3.1]]), torch.tensor([-3.0]), [0])
        >>> predicted.mean().round(decimals=2).abs(), (reading - predicted.mean()).round(decimals=2)
        (tensor(3.1400), tensor([0.1400]))
    """
    if not angles:
        return predicted, observation
    samples = observation if observation.ndim == predicted.ndim else observation.unsqueeze(-2)
    if observed is not None:
        samples = torch.where(observed.unsqueeze(-2), samples, 0)
    center, own = _circular_mean(predicted), _circular_mean(samples)
    samples = center + wrap_angles(own - center, angles) + wrap_angles(samples - own, angles)
    predicted = center + wrap_angles(predicted - center, angles)
    return predicted, samples if observation.ndim == predicted.ndim else samples.squeeze(-2)


def mean_observation(samples: Tensor, angles: Sequence[int]) -> Tensor:
    """The mean ``[*B, O]`` of samples ``[*B, E, O]``, with angles on one turn.

    Examples:
        >>> mean_observation(torch.tensor([[3.1], [-3.1]]), [0]).abs()
        tensor([3.1416])
    """
    if not angles:
        return samples.mean(-2)
    center = _circular_mean(samples)
    return (center + wrap_angles(samples - center, angles)).mean(-2)


def _circular_mean(values: Tensor) -> Tensor:
    """The direction of the sum of unit vectors, ``[*B, 1, O]``; a constant to the gradient: it only picks the turn."""
    values = values.detach()
    return torch.atan2(values.sin().mean(-2, keepdim=True), values.cos().mean(-2, keepdim=True))
