"""Readings that are too old, and those between which there is too long a gap."""

import numpy as np

from torch_denkf.data.recordings.clock import interpolate, last_reading


def test_a_reading_that_is_too_old_is_none_and_not_observed():
    index, new = last_reading(np.array([0.0, 4.0]), np.arange(6.0), 1.0)
    assert index.tolist() == [0, 0, -1, -1, 1, 1]
    assert new.tolist() == [True, False, False, False, True, False]


def test_no_line_across_a_gap_that_is_longer_than_the_tolerance():
    times, values = np.array([0.0, 1.0, 2.5, 3.5]), np.array([[0.0], [1.0], [2.5], [3.5]])
    value, there = interpolate(times, values, np.arange(8) / 2, 1.0)
    assert there.tolist() == [True, True, True, False, False, True, True, True]
    assert value[:, 0].tolist() == [0, 0.5, 1, 0, 0, 2.5, 3, 3.5]
