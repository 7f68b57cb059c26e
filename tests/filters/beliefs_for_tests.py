"""Entries of a belief, and whether two beliefs are the same but for rounding."""

from tests.filters.factories import assert_equal

ENSEMBLE, MEAN, COV, VAR = (("belief", name) for name in ("ensemble", "mean", "cov", "var"))
BELIEF = [ENSEMBLE, MEAN, VAR]


def close(first, second, keys, atol=1e-12):
    """In float64: the rounding of a few steps."""
    assert_equal(first, second, keys, atol=atol)
