"""Compares the two sides of the pair with dynamax; needs the packages of ``[bench]``."""

import pytest

from benchmarks.speed.workload import make_gaussian_filter

pytest.importorskip("dynamax")


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("kind", ["EKF", "UKF"])
def test_dynamax_computes_the_same_beliefs(kind, batch):
    from benchmarks.speed.against_dynamax import same_beliefs

    same_beliefs(make_gaussian_filter(kind), kind, batch)
