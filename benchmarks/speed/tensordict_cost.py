"""Compares the filter on a tensordict with its own functional step, without pandas.

tensordict looks for pandas on some writes, which is slowest if it is not installed: here the search never finds it.
"""

from __future__ import annotations

import importlib.util

from benchmarks.speed.ours import functional_loop, steps
from benchmarks.speed.pairs import Row, against
from benchmarks.speed.workload import make_filter

NOTE = "one step each, the functions eager; both draw their noise and compute all outputs; pandas hidden"


def without_pandas() -> None:
    """Makes every search for pandas fail as slowly as one for a missing package."""
    search = importlib.util.find_spec

    def find_spec(name: str, package: str | None = None):
        return search("pandas_that_is_not_installed" if name == "pandas" else name, package)

    importlib.util.find_spec = find_spec


def rows(seconds: float) -> list[Row]:
    without_pandas()
    out = []
    for batch, target in ((1, 1.15), (64, 1.05)):
        plain, title = functional_loop(make_filter(), batch), f"step on a tensordict / its functions, B={batch}"
        fields = {"how": {"seconds": seconds}, "target": target, "note": NOTE}
        out += against(steps(batch), "functional", plain, title, **fields)
    return out
