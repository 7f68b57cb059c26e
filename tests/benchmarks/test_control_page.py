"""Figures of the page, by hand."""

import pytest

from benchmarks.control.page import ahead, page


def row(arm, seed, value=0.0, steps=1000, seconds=1.0):
    entries = {"arm": arm, "seed": seed, "env_steps": steps, "return": value, "wall_s": seconds}
    return {"task": "hike", "cell": "noise 0", **entries}


@pytest.mark.parametrize("order", [1, -1], ids=["forward", "backward"])
def test_arms_are_compared_with_each_seed_that_both_have(order):
    """Seed 0 returns 10 and 1, seed 2 returns 40 and 5; of seed 1 there is nothing to compare with."""
    own = [row("belief mean", seed, value) for seed, value in ((0, 10.0), (1, 20.0), (2, 40.0))]
    others = [row("LSTM", seed, value) for seed, value in ((0, 1.0), (2, 5.0))]
    rows = own + others[::order]
    assert ahead(rows, "hike", "noise 0", "belief mean", "LSTM") == [9.0, 35.0]
    assert ahead(rows, "hike", "noise 0", "LSTM", "belief mean") == [-9.0, -35.0][::order]


def test_seconds_of_an_arm_are_the_median_of_its_runs():
    """Whole runs took 1, 2 and 9 s, and 3, 40 and 5 s; what they had taken at an earlier test does not count."""
    taken = {"LSTM": (1.0, 2.0, 9.0), "belief mean": (3.0, 40.0, 5.0)}
    rows = [
        row(arm, seed, steps=steps, seconds=share * seconds)
        for arm, all_seconds in taken.items()
        for seed, seconds in enumerate(all_seconds)
        for steps, share in ((500, 0.1), (1000, 1.0))
    ]
    below = page(rows).partition("Seconds of one core for a run")[2].splitlines()
    assert [line for line in below if line.startswith("| ")] == ["| LSTM | belief mean |", "| 2 | 5 |"]
