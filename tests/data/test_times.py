"""Readings that are too old, and those between which there is too long a gap."""

import warnings
from functools import partial

import numpy as np
import pytest

from tests.data.recordings.own_files import write_csv
from torch_denkf.data import Recording, RecordingReplay, Table
from torch_denkf.data.times import interpolate


def test_no_line_across_a_gap_that_is_longer_than_the_tolerance():
    times, values = np.array([0.0, 1.0, 2.5, 3.5]), np.array([[0.0], [1.0], [2.5], [3.5]])
    value, there = interpolate(times, values, np.arange(8) / 2, 1.0)
    assert there.tolist() == [True, True, True, False, False, True, True, True]
    assert value[:, 0].tolist() == [0, 0.5, 1, 0, 0, 2.5, 3, 3.5]


def test_readings_that_share_a_row_are_told(tmp_path):
    """An encoder at 100 Hz with jittering times, on a clock of 100 Hz: of two in a row one stays."""
    rng = np.random.default_rng(0)
    time = np.arange(400) / 100 + rng.uniform(0, 0.004, 400) * (np.arange(400) % 2)
    late = time + 0.0035 * (np.arange(400) % 3 == 0)
    write_csv(tmp_path / "encoder.csv", time=np.sort(late), angle=np.arange(400.0))
    recording = partial(Recording, name="run")
    with pytest.warns(UserWarning, match=r"'run': \d+ of \d+ readings of 'encoder' share a row .*sample='nearest'"):
        RecordingReplay(recording(encoder=Table(tmp_path / "encoder.csv")), clock=100.0, cache=None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a slower clock has no row for each reading, and a clock of its own has
        RecordingReplay(recording(encoder=Table(tmp_path / "encoder.csv")), clock=20.0, cache=None)
        RecordingReplay(recording(encoder=Table(tmp_path / "encoder.csv")), clock="encoder", cache=None)
