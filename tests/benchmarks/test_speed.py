"""Compares the two sides of pairs: numpy's attitude filter with the library's, and dynamax, where it is installed."""

import pytest
import torch
from torch.testing import assert_close

from benchmarks.speed.one_row import attitude, numpy_attitude
from benchmarks.speed.workload import make_gaussian_filter


def test_numpy_computes_the_same_attitudes(float64):
    """They share no code."""
    filter, row = attitude()
    filter.initialise(row)
    call = numpy_attitude()
    for _ in range(50):
        filter.step(row)
        turn = call()
    assert_close(row["belief", "mean"][:, :4], torch.from_numpy(turn), rtol=0, atol=1e-9)


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("kind", ["EKF", "UKF"])
def test_dynamax_computes_the_same_beliefs(kind, batch):
    pytest.importorskip("dynamax")
    from benchmarks.speed.against_dynamax import same_beliefs

    same_beliefs(make_gaussian_filter(kind), kind, batch)
