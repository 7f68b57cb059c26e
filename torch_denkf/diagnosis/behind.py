"""Raises where another transform of an environment writes over the belief that a filter continues with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tensordict import NestedKey, unravel_key
from torchrl.envs.transforms import Compose, DTypeCastTransform, Transform, TransformedEnv

__all__ = ["check_behind"]


def check_behind(transform: Transform, carry: Sequence[NestedKey]) -> None:
    """Raises if a transform behind a filter's one overwrites the filter's carry.

    One that casts a type does not: its inverse casts it back. What an environment outside of a batched one does, as
    around a ``ParallelEnv``, is not seen.

    Args:
        transform: of the filter.
        carry: what it carries, by its names in the environment.

    Raises:
        ValueError: that names the transform and the entry.
    """
    environment, behind = transform.container, False
    for other in _flat(environment.transform) if isinstance(environment, TransformedEnv) else ():
        written = [key for key in map(unravel_key, other.out_keys or []) if key in carry]
        if behind and written and not isinstance(other, DTypeCastTransform | type(transform)):
            raise ValueError(
                f"{type(other).__name__} behind {type(transform).__name__} writes over {written[0]!r}, which the next "
                "step of the filter starts from. Let it write elsewhere, for example out_keys=['policy_input']."
            )
        behind |= other is transform


def _flat(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for part in transform:
            yield from _flat(part)
    else:
        yield transform
