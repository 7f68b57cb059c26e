"""Checks that no later transform of an environment overwrites a filter's carry."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tensordict import NestedKey, unravel_key
from torchrl.envs.transforms import Compose, DTypeCastTransform, Transform, TransformedEnv

__all__ = ["check_behind"]


def check_behind(transform: Transform, carry: Sequence[NestedKey]) -> None:
    """Raises if a transform after the filter's transform overwrites the filter's carry.

    Casts of a dtype are allowed, as their inverse casts back. Transforms outside of a batched environment, as around a
    ``ParallelEnv``, are not checked.

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
