"""Compares the two sides of a pair: numpy's attitude filter with the library's."""

import torch
from torch.testing import assert_close

from benchmarks.speed.one_row import attitude, numpy_attitude


def test_numpy_computes_the_same_attitudes(float64):
    """They share no code."""
    filter, row = attitude()
    filter.initialise(row)
    call = numpy_attitude()
    for _ in range(50):
        filter.step(row)
        turn = call()
    assert_close(row["belief", "mean"][:, :4], torch.from_numpy(turn), rtol=0, atol=1e-9)
