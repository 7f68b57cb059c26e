"""Bootstrap intervals of statistics over episodes or seeds."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import bootstrap


def bootstrap_interval(
    values: Sequence[float], statistic: Callable[..., np.ndarray] = np.mean
) -> tuple[float, float, float]:
    """Returns a statistic, and the bounds of its 95 % percentile bootstrap interval.

    The bounds are NaN if there is only one value, or all values are equal.

    Args:
        values: one for each episode or seed; for two cases with the same ones, their paired differences.
        statistic: takes ``axis``.
    """
    center = float(statistic(values))
    if len(values) < 2 or np.ptp(values) == 0:
        return center, np.nan, np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        interval = bootstrap((np.asarray(values),), statistic, method="percentile", rng=0)
    return center, *map(float, interval.confidence_interval)
