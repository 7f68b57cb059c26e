"""Oracles: the normal interval of a mean, and what a bootstrap of equal values has."""

import numpy as np
import pytest

from benchmarks.common.intervals import bootstrap_interval


def test_large_sample_interval_is_normal():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    center, low, high = bootstrap_interval(values)
    half = 1.96 * values.std() / 20
    assert center == pytest.approx(values.mean())
    assert (center - low, high - center) == pytest.approx((half, half), rel=0.06)


def test_no_interval_for_one_value_or_equal_values():
    for values in ([2.0], [2.0, 2.0, 2.0]):
        center, low, high = bootstrap_interval(values)
        assert center == 2.0
        assert np.isnan([low, high]).all()
