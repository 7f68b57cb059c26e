"""Arguments that several objectives take, described once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypedDict

from torch import Tensor

__all__ = ["DimensionsOptions", "ReadingsOptions", "Scale", "SequenceOptions"]

#: A scale of each dimension; infinite where the dimension does not count.
Scale = Sequence[float] | Tensor | None


class ReadingsOptions(TypedDict, total=False):
    """What every objective that scores readings takes.

    Attributes:
        observation_scale: ``[O]``; errors of observations are divided by it, so that dimensions with different units
            count alike. A dimension with infinite scale does not count: means are taken over the others. A term that
            is a likelihood stays a density in the observation's own units.
        observation_angles: dimensions of observations that are angles in radians; their errors are wrapped to
            [-pi, pi).
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``: the shape of the batch, zero where an element does
            not count.
    """

    observation_scale: Scale
    observation_angles: Sequence[int]
    reduction: Literal["mean", "sum", "none"]


class SequenceOptions(ReadingsOptions, total=False):
    """What every objective of a whole filter takes.

    Attributes:
        state_scale: ``[S]``; errors of the state are divided by it. A dimension with infinite scale does not count.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        detach_every: truncated back-propagation: steps after which the belief is detached.
    """

    state_scale: Scale
    angles: Sequence[int]
    detach_every: int | None


class DimensionsOptions(SequenceOptions, total=False):
    """What the objectives take that can leave dimensions of the state out.

    Attributes:
        dims: state dimensions that count; all of the truth's by default. The belief may have more dimensions than the
            truth, which must then come first. ``state_scale`` has one entry for each of them, while ``angles`` are
            counted in the whole state.
    """

    dims: Sequence[int] | None
