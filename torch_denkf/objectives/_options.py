"""Arguments that several objectives take, described once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypedDict

from torch import Tensor

__all__ = ["ReadingsOptions", "Scale", "SequenceOptions"]

#: A scale of each dimension; infinite where the dimension does not count.
Scale = Sequence[float] | Tensor | None


class ReadingsOptions(TypedDict, total=False):
    """What every objective that scores readings takes.

    Labels, true states and true observations, may have gaps. A mask of labels, which is named like them with
    ``_observed`` behind (``"state_observed"``; ``[*B, 1]``, or one for each dimension), says where there are some, and
    NaN is none. A gap has no value and no gradient: a score is of the dimensions that have a label, and means are over
    the elements that have one. Of a batch without any the loss is zero.

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

    The true state may have fewer dimensions than the belief: its labels are of the leading ones, or of ``dims``.

    Attributes:
        dims: state dimensions that count; all that have labels by default. Labels are of the leading dimensions; or of
            ``dims`` alone, in their order, where some of these lie beyond as many leading ones.
        state_scale: one for each of ``dims``, else of the labels' dimensions; errors of the state are divided by it. A
            dimension with infinite scale does not count.
        angles: state dimensions that are angles in radians, counted in the whole state; their errors are wrapped to
            [-pi, pi).
        detach_every: truncated back-propagation: steps after which the belief is detached.
    """

    dims: Sequence[int] | None
    state_scale: Scale
    angles: Sequence[int]
    detach_every: int | None
