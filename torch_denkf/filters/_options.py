"""What the constructors of all filters share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypedDict

from tensordict import NestedKey

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["FilterOptions", "options_of"]


class FilterOptions(TypedDict, total=False):
    """What every filter's constructor takes beside its parts; see :class:`Filter`."""

    control_keys: Sequence[NestedKey]
    init_key: NestedKey
    update_at_reset: bool
    forecast_keys: Mapping[NestedKey, NestedKey] | None
    variance_ceiling: float | None
    check_finite: bool
    reject: bool
    prefix: str | None


def options_of(filter: Filter) -> FilterOptions:
    """The options that a filter was made with."""
    return {
        "control_keys": filter.control_keys,
        "init_key": filter.init_key,
        "update_at_reset": filter.update_at_reset,
        "forecast_keys": filter.forecast_keys,
        "variance_ceiling": filter.variance_ceiling,
        "check_finite": filter.check_finite,
        "reject": filter.reject,
        "prefix": filter.prefix,
    }
