"""Keys of a belief's entries, and an assertion that two beliefs are equal up to rounding."""

from tests.filters.factories import assert_equal

ENSEMBLE, MEAN, COV, VAR = (("belief", name) for name in ("ensemble", "mean", "cov", "var"))
BELIEF = [ENSEMBLE, MEAN, VAR]


def close(first, second, keys, atol=1e-12):
    """Asserts that entries are equal up to the float64 rounding of a few steps."""
    assert_equal(first, second, keys, atol=atol)
