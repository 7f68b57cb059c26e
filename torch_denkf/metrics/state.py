"""Errors of an estimated state, one figure for each of its dimensions.

A truth that is NaN is not known: it counts nowhere. Of data with a mask of labels that is
``truth.where(data["state_observed"], torch.nan)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.functional import wrap_angle

__all__ = ["StateErrors", "mean_of_known", "state_difference", "state_errors"]


class StateErrors(NamedTuple):
    """What :func:`state_errors` returns.

    Attributes:
        rmse: root of the mean squared error, ``[S]``, in each dimension's units.
        mae: mean absolute error, ``[S]``, in each dimension's units.
    """

    rmse: Tensor
    mae: Tensor


def state_difference(estimated: Tensor, truth: Tensor, *, angles: Sequence[int] = ()) -> Tensor:
    """Estimate minus truth, where headings that differ by whole turns are the same.

    Args:
        estimated: states, ``[*B, S]``.
        truth: the true states, of the same shape.
        angles: dimensions that are angles in rad; (2,) of KITTI's (x, y, θ, v, θ_dot). Turn rates are none.

    Returns:
        The differences, ``[*B, S]``; angles in [-π, π).

    Raises:
        ValueError: if the shapes differ.
        IndexError: if there is no such dimension.

    Examples:
        >>> import torch
        >>> state_difference(torch.tensor([1.0, 3.0]), torch.tensor([0.0, -3.0]), angles=(1,))
        tensor([ 1.0000, -0.2832])
    """
    if estimated.ndim < 1 or estimated.shape != truth.shape:
        raise ValueError(
            f"estimate and truth must both be [*B, S], got {list(estimated.shape)} and {list(truth.shape)}; for "
            "ensembles pass the mean"
        )
    difference = estimated - truth
    for dim in angles:
        if not -truth.shape[-1] <= dim < truth.shape[-1]:
            raise IndexError(f"angles names dimension {dim} of a state of {truth.shape[-1]} dimensions")
        difference[..., dim] = wrap_angle(difference[..., dim].clone())
    return difference


def state_errors(estimated: Tensor, truth: Tensor, *, angles: Sequence[int] = ()) -> StateErrors:
    """Root mean square and mean absolute error of each dimension, over all batch dims.

    Dimensions are kept apart: a mean over metres, radians and metres per second, as the reference script of the DEnKF
    paper prints it, is ruled by whichever unit has the largest numbers.

    Args:
        estimated: states, ``[*B, S]``, such as the mean of a belief.
        truth: the true states, of the same shape; NaN where they are not known, which does not count.
        angles: dimensions that are angles in rad, see :func:`state_difference`.

    Returns:
        A :class:`StateErrors`; NaN in a dimension whose truth is nowhere known.

    Raises:
        ValueError: if the shapes differ or there are no states.
        IndexError: if ``angles`` names no dimension.

    Examples:
        >>> import torch
        >>> errors = state_errors(torch.tensor([[3.0, 6.0], [1.0, 0.0]]), torch.zeros(2, 2), angles=(1,))
        >>> errors.rmse, errors.mae
        (tensor([2.2361, 0.2002]), tensor([2.0000, 0.1416]))
    """
    difference = state_difference(estimated, truth, angles=angles)
    if difference.numel() == 0:
        raise ValueError(f"there are no states to average over, got {list(truth.shape)}")
    return StateErrors(mean_of_known(difference.square(), truth).sqrt(), mean_of_known(difference.abs(), truth))


def mean_of_known(values: Tensor, truth: Tensor) -> Tensor:
    """The mean of values ``[*B, S]`` over all batch dims, where the truth ``[*B, S]`` is not NaN, ``[S]``.

    Examples:
        >>> mean_of_known(torch.tensor([[1.0], [3.0], [9.0]]), torch.tensor([[0.0], [0.0], [torch.nan]]))
        tensor([2.])
    """
    known = ~truth.isnan().reshape(-1, truth.shape[-1])
    return torch.where(known, values.reshape(-1, truth.shape[-1]), 0).sum(0) / known.sum(0)
