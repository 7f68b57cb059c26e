"""Options that the constructors of all filters share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypedDict

from tensordict import NestedKey

__all__ = ["FilterOptions"]


class FilterOptions(TypedDict, total=False):
    """Options of every filter's constructor, in addition to its parts; see :class:`Filter`."""

    control_keys: Sequence[NestedKey]
    init_key: NestedKey
    update_at_reset: bool
    forecast_keys: Mapping[NestedKey, NestedKey] | None
    variance_ceiling: float | None
    check_finite: bool
    keep_noise: bool
    prefix: str | None
