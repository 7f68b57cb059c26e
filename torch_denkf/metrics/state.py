"""Errors of an estimated state, one figure for each of its dimensions.

A truth that is NaN is not known: it counts nowhere. Of data with a mask of labels that is
``truth.where(data["state_observed"], torch.nan)``.

States may be points of a space, such as ``Product(SO3(), Euclidean(3))``: pass ``space=``, of numbers of
which some are angles :class:`~torch_denkf.functional.manifolds.Flat`.
Errors, variances and covariances are then those of tangents, ``[*B, D]``, and each figure is one of a component of
tangents. A part of the space whose truth is NaN in places is not known.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import Space, check_space, places_of, whole_parts

__all__ = ["StateErrors", "known_tangents", "mean_of_known", "rotation_error", "state_difference", "state_errors"]


class StateErrors(NamedTuple):
    """Holds the results of :func:`state_errors`.

    Attributes:
        rmse: root of the mean squared error, ``[S]``, in each dimension's units.
        mae: mean absolute error, ``[S]``, in each dimension's units.
    """

    rmse: Tensor
    mae: Tensor


def state_difference(estimated: Tensor, truth: Tensor, *, space: Space | None = None) -> Tensor:
    """Subtracts the truth from the estimate; headings that differ by whole turns are the same.

    From the truth to the estimate and back leads a tangent and its negative: it is the error at either.

    Args:
        estimated: states, ``[*B, S]``.
        truth: the true states, of the same shape.
        space: whose points the states are, such as ``Flat(5, circular=[2])`` of (x, y, θ, v, θ_dot); ``None``
            for plain numbers. Turn rates are no angles.

    Returns:
        The differences, ``[*B, S]``; angles in [-π, π). Of points of a space the tangents, ``[*B, D]``.

    Raises:
        ValueError: if the shapes differ, or for points of another space.

    Examples:
        >>> import torch
        >>> from torch_denkf.functional.manifolds import Circle, Euclidean
        >>> space = Euclidean(1) * Circle()
        >>> state_difference(torch.tensor([1.0, 3.0]), torch.tensor([0.0, -3.0]), space=space)
        tensor([ 1.0000, -0.2832])
    """
    if estimated.ndim < 1 or estimated.shape != truth.shape:
        raise ValueError(
            f"estimate and truth must both be [*B, S], got {list(estimated.shape)} and {list(truth.shape)}; for "
            "ensembles pass the mean"
        )
    space = check_space("space", space)
    return estimated - truth if space is None else space.minus(estimated, truth)


def state_errors(estimated: Tensor, truth: Tensor, *, space: Space | None = None) -> StateErrors:
    """Returns root mean square and mean absolute error of each dimension, over all batch dims.

    Dimensions are kept apart: a mean over metres, radians and metres per second, as the reference script of the DEnKF
    paper prints it, is ruled by whichever unit has the largest numbers.

    Args:
        estimated: states, ``[*B, S]``, such as the mean of a belief.
        truth: the true states, of the same shape; NaN where they are not known, which does not count.
        space: whose points the states are, see :func:`state_difference`; ``None`` for plain numbers. See
            :func:`rotation_error` for angles between orientations.

    Returns:
        A :class:`StateErrors`; NaN in a dimension whose truth is nowhere known.

    Raises:
        ValueError: if the shapes differ, there are no states, or for points of another space.

    Examples:
        >>> import torch
        >>> from torch_denkf.functional.manifolds import Circle, Euclidean
        >>> space = Euclidean(1) * Circle()
        >>> errors = state_errors(torch.tensor([[3.0, 6.0], [1.0, 0.0]]), torch.zeros(2, 2), space=space)
        >>> errors.rmse, errors.mae
        (tensor([2.2361, 0.2002]), tensor([2.0000, 0.1416]))
    """
    difference = state_difference(estimated, truth, space=space)
    if difference.numel() == 0:
        raise ValueError(f"there are no states to average over, got {list(truth.shape)}")
    truth = known_tangents(truth, space)
    return StateErrors(mean_of_known(difference.square(), truth).sqrt(), mean_of_known(difference.abs(), truth))


def rotation_error(estimated: Tensor, truth: Tensor, *, space: Space) -> Tensor:
    """Returns the angle between an estimated and a true orientation, in degrees.

    It is the length of the shortest turn from one to the other, the geodesic distance.

    Args:
        estimated: points of the space, ``[*B, P]``.
        truth: the true points, of the same shape; NaN where they are not known.
        space: one with K orientations: ``Circle``, ``SO3``, ``SE2``, ``SE3``, ``SE23``, or a product with some.

    Returns:
        ``[*B, K]``, in [0, 180]; NaN where the truth is.

    Raises:
        ValueError: if the shapes do not fit, or if the space has no orientation.

    Examples:
        >>> import torch
        >>> from torch_denkf.functional.manifolds import SO3
        >>> upright, quarter_turn = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.7071, 0.0, 0.0, 0.7071]])
        >>> rotation_error(upright, quarter_turn, space=SO3()).round(decimals=2)
        tensor([90.])
    """
    error = state_difference(estimated, truth, space=space)
    turns = [place.rotation for place in places_of(space) if place.rotation.start < place.rotation.stop]
    if not turns:
        raise ValueError(f"{space} has no orientation; see state_errors")
    return torch.stack([torch.linalg.vector_norm(error[..., turn], dim=-1) for turn in turns], -1).rad2deg()


def check_level(level: float) -> None:
    """Raises a ``ValueError`` unless a level is a probability of an interval, in (0, 1)."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is the probability of the interval, in (0, 1); got {level}.")


def known_tangents(truth: Tensor, space: Space | None) -> Tensor:
    """Marks unknown errors by NaN: the truth ``[*B, S]``, of points of a space zeros and NaN, ``[*B, D]``."""
    if space is None:
        return truth
    known = whole_parts(space, ~truth.isnan())[1]
    return torch.zeros_like(known, dtype=truth.dtype).where(known, torch.nan)


def mean_of_known(values: Tensor, truth: Tensor) -> Tensor:
    """Returns the mean of values ``[*B, S]`` over all batch dims, where the truth ``[*B, S]`` is not NaN, ``[S]``.

    Examples:
        >>> mean_of_known(torch.tensor([[1.0], [3.0], [9.0]]), torch.tensor([[0.0], [0.0], [torch.nan]]))
        tensor([2.])
    """
    known = ~truth.isnan().reshape(-1, truth.shape[-1])
    return torch.where(known, values.reshape(-1, truth.shape[-1]), 0).sum(0) / known.sum(0)
