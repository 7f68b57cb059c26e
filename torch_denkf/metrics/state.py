"""Errors of an estimated state, one number for each of its dimensions.

A truth that is NaN is unknown, and left out. For data with a mask of labels, pass
``truth.where(data["state_observed"], torch.nan)``.

States may be points of a space, such as ``Product(SO3(), Euclidean(3))``: pass ``space=``. For vectors in which some
components are angles, this is :class:`~torch_denkf.functional.manifolds.Flat`.
Errors, variances and covariances are then of tangents, ``[*B, D]``, one number for each component of
tangents. If one component of a rotation or pose has an unknown truth, all of it is unknown.
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

    On a space the error is the tangent from the truth to the estimate; the tangent back is its negative.

    Args:
        estimated: states, ``[*B, S]``.
        truth: the true states, of the same shape.
        space: space of the states, such as ``Flat(5, circular=[2])`` for (x, y, θ, v, θ_dot); ``None``
            for plain numbers. Turn rates are not angles.

    Returns:
        The differences, ``[*B, S]``; angles in [-π, π). For points of a space the tangents, ``[*B, D]``.

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

    Dimensions are separate: a mean over metres, radians and metres per second, as in the reference script of the
    DEnKF paper, is dominated by the unit with the largest numbers.

    Args:
        estimated: states, ``[*B, S]``, such as the mean of a belief.
        truth: the true states, of the same shape; NaN where unknown, which is left out.
        space: space of the states, see :func:`state_difference`; ``None`` for plain numbers. See
            :func:`rotation_error` for angles between orientations.

    Returns:
        A :class:`StateErrors`; NaN in a dimension whose truth is never known.

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

    It is the geodesic distance, the angle of the shortest rotation from one to the other.

    Args:
        estimated: points of the space, ``[*B, P]``.
        truth: the true points, of the same shape; NaN where unknown.
        space: space with K orientations: ``Circle``, ``SO3``, ``SE2``, ``SE3``, ``SE23``, or a product with some.

    Returns:
        ``[*B, K]``, in [0, 180]; NaN where the truth is NaN.

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
    """Raises a ``ValueError`` unless ``level`` is the probability of an interval, in (0, 1)."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is the probability of the interval, in (0, 1); got {level}.")


def known_tangents(truth: Tensor, space: Space | None) -> Tensor:
    """Marks unknown errors by NaN: returns the truth ``[*B, S]``, or for points zeros and NaN, ``[*B, D]``."""
    if space is None:
        return truth
    known = whole_parts(space, ~truth.isnan())[1]
    return torch.zeros_like(known, dtype=truth.dtype).where(known, torch.nan)


def mean_of_known(values: Tensor, truth: Tensor) -> Tensor:
    """Returns the mean of values ``[*B, S]`` over all batch dims where the truth ``[*B, S]`` is not NaN, ``[S]``.

    Examples:
        >>> mean_of_known(torch.tensor([[1.0], [3.0], [9.0]]), torch.tensor([[0.0], [0.0], [torch.nan]]))
        tensor([2.])
    """
    known = ~truth.isnan().reshape(-1, truth.shape[-1])
    return torch.where(known, values.reshape(-1, truth.shape[-1]), 0).sum(0) / known.sum(0)
