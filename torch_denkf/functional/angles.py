"""Wraps angles in radians to one turn."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def wrap_angles(values: Tensor) -> Tensor:
    """Wraps angles to [-pi, pi).

    Args:
        values: angles in radians, of any shape. For vectors in which only some components are angles, see
            :class:`~torch_denkf.functional.manifolds.Flat`.

    Returns:
        The same directions, of the same shape.

    Examples:
        >>> wrap_angles(torch.tensor([0.5, 4.0, -4.0]))
        tensor([ 0.5000, -2.2832,  2.2832])
    """
    return torch.remainder(values + math.pi, 2 * math.pi) - math.pi
