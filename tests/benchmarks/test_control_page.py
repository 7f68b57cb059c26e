"""Figures of the page, by hand."""

import pytest

from benchmarks.control.page import ahead


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
