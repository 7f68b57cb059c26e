"""The search for PPO's learning rate: what runs, what is chosen, what the study takes of it."""

import sys

import pytest

from benchmarks.control import search as protocol
from benchmarks.control.search import FIRST, best, page


def rows(returns, arm="LSTM", task="hike"):
    """One row for each return, by rate and seed."""
    return [
        {"task": task, "arm": arm, "rate": rate, "seed": seed, "env_steps": 100, "return": value, "wall_s": 1.0}
        for rate, values in returns.items()
        for seed, value in enumerate(values, FIRST)
    ]


def test_the_best_rate_is_that_of_the_best_mean():
    """Means -20, -15, -16; the best single run is of the third."""
    tried = rows({0.3: [-20.0, -20.0], 1.0: [-14.0, -16.0], 3.0: [-10.0, -22.0]})
    assert best(tried, "hike", "LSTM") == 1.0
    text = page(tried + rows({0.3: [-9.0], 1.0: [-8.0], 3.0: [-7.0], 10.0: [-6.0]}, "GRU"))
    assert "| LSTM | 2 | -20.0 | **-15.0** | -16.0 |  |" in text
    assert "| GRU | 1 | -9.0 | -8.0 | -7.0 | **-6.0** |" in text
    text = page(tried + rows({0.3: [-9.0], 1.0: [-8.0], 10.0: [-7.0]}, "GRU", "pendulum"))
    assert "## Mountain hike, noise 0.4\n\n| arm | seeds | rate x 0.3 | rate x 1 | rate x 3 |\n" in text
    assert (
        "## Pendulum without velocity, noise 0.2, 30% missing\n\n| arm | seeds | rate x 0.3 | rate x 1 | rate" in text
    )
    assert "| GRU | 1 | -9.0 | -8.0 | **-7.0** |" in text


@pytest.fixture
def search(tmp_path, monkeypatch):
    """Searches with some options, whose runs take no time; they return 10 less the factor's distance from 1.

    The GRU returns the factor. Says which runs were made; more than a number of them are broken off.
    """

    def search(*options, runs=1000):
        made = []

        def run(task, cell, arm, seed, budget):
            if len(made) == runs:
                raise KeyboardInterrupt
            made.append((task, cell, arm, seed, budget))
            value = budget.rate if arm == "GRU" else 10 - abs(budget.rate - 1)
            return [{"task": task, "arm": arm, "seed": seed, "env_steps": 9, "return": value, "wall_s": 1.0}]

        monkeypatch.setattr(protocol, "run", run)
        monkeypatch.setattr(sys, "argv", ["search", "--out", str(tmp_path), *options])
        try:
            protocol.main()
        except KeyboardInterrupt:
            assert len(made) == runs
        return made

    return search
