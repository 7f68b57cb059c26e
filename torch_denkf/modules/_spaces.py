"""Beliefs and readings on a space: as tangents at a mean, where they are plain numbers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import Space

__all__ = ["checked_space", "checked_spaces", "mean_and_tangents", "reading_about", "without_hidden"]


def checked_space(name: str, space: Space | None) -> Space | None:
    """The space.

    Raises:
        TypeError: if it is none.
    """
    if space is not None and not isinstance(space, Space):
        raise TypeError(f"{name} is a Space, such as SO3() or Product(SE2(), Euclidean(2)); got {space!r}.")
    return space


def checked_spaces(
    space: Space | None, reading_space: Space | None, angles: Sequence[int]
) -> tuple[Space | None, Space | None]:
    """The spaces of the state and of the reading.

    Raises:
        TypeError: if one is none.
        ValueError: if the reading has a space and angles.
    """
    if reading_space is not None and angles:
        raise ValueError(f"reading_space={reading_space} says what is an angle: leave angles={list(angles)} away.")
    return checked_space("space", space), checked_space("reading_space", reading_space)


def mean_and_tangents(space: Space, ensemble: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """The mean ``[*B, P]`` of members, and the tangents ``[*B, E, D]`` to them, by two steps from a point near it.

    For members that an update has just placed about ``start`` ``[*B, P]``; wide ones need more, see :meth:`Space.mean`.
    """
    mean = start
    for _ in range(2):
        away = space.minus(ensemble, mean.unsqueeze(-2))
        mean = space.plus(mean, away.mean(-2))
    return mean, away


def reading_about(space: Space, predicted: Tensor, reading: Tensor, observed: Tensor | None) -> tuple[Tensor, Tensor]:
    """What members predict, and a reading, as tangents at a point near the predictions' mean.

    Args:
        space: of the reading.
        predicted: points ``[*B, E, Q]``.
        reading: a point ``[*B, Q]``, or samples ``[*B, E, Q]``.
        observed: mask ``[*B, 1]``, or one for each number of a tangent ``[*B, O]``; ``None`` where all is observed.

    Returns:
        Tangents ``[*B, E, O]``, and ``[*B, O]`` or ``[*B, E, O]``.
    """
    center = space.near(predicted)
    expected = center.unsqueeze(-2)
    about = expected if reading.ndim == predicted.ndim else center
    return space.minus(predicted, expected), space.minus(without_hidden(reading, about, observed), about)


def without_hidden(reading: Tensor, expected: Tensor, observed: Tensor | None) -> Tensor:
    """The reading, with what is expected in the place of numbers that are not finite behind a mask."""
    if observed is None:
        return reading
    seen = observed.all(-1, keepdim=True)
    if reading.ndim > observed.ndim:
        seen = seen.unsqueeze(-2)
    return torch.where(seen | reading.isfinite(), reading, expected)
