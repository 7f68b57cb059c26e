"""Nothing that the library computes has changed since its golden values were written."""

import json

import pytest

from tests.golden.library import FILE, values

GOLDEN = json.loads(FILE.read_text())


@pytest.fixture(scope="module")
def now() -> dict[str, list[float]]:
    return values()


def test_names(now):
    assert sorted(now) == sorted(GOLDEN)


@pytest.mark.parametrize("name", sorted(GOLDEN))
def test_golden(name, now):
    # Double precision and a few steps: 1e-9 is rounding. The shipped filters compute in single precision.
    single = name.startswith(("weights", "study: single"))
    assert now[name] == pytest.approx(GOLDEN[name], rel=1e-4 if single else 1e-9, abs=1e-5 if single else 1e-11)
