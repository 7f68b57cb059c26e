"""The search for PPO's learning rate: what runs, what is chosen, what the study takes of it."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.control import search as protocol
from benchmarks.control import study
from benchmarks.control.run import Budget, run
from benchmarks.control.search import ARMS, CELLS, COLUMNS, FIRST, Search, best, complete, found, jobs, page
from benchmarks.control.study import BELIEFS
from benchmarks.control.tasks import RATES, TASKS


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


def test_all_arms_get_the_same_rates_and_the_largest_is_exceeded_where_it_is_best(tmp_path):
    search = Search(out=tmp_path, seeds=2)
    assert set(ARMS) >= {"Kalman", "belief mean", "truth", *study.MEMORIES}
    files = [call.args[0].relative_to(tmp_path / "parts") for call in jobs(search)]
    assert len(files) == len(set(files)) == 3 * 2 * (len(ARMS) + len(ARMS) - 1)  # the pendulum has no Kalman filter
    small, large = {0.3: [-3.0], 1.0: [-1.0], 3.0: [-2.0]}, {0.3: [-3.0], 1.0: [-2.0], 3.0: [-1.0]}
    tried = [row for arm in ARMS for task in CELLS for row in rows(large if arm == "GRU" else small, arm, task)]
    further = [call.args[0].relative_to(tmp_path / "parts").as_posix() for call in jobs(search, tried)]
    assert sorted(further) == [f"{task}/GRU-10-{seed}.json" for task in ("hike", "pendulum") for seed in (100, 101)]
    tried += [row for task in CELLS for row in rows({10.0: [0.0]}, "GRU", task)]  # the best, with one of two seeds
    assert [call.args[0].relative_to(tmp_path / "parts").as_posix() for call in jobs(search, tried)] == further


def test_a_run_has_its_rate(monkeypatch):
    """Of the task's learning rate 0.3 times; without one, what the search chose for the arm."""
    rates = []
    task = TASKS["hike"]

    class Noted(task.agent):
        def __init__(self, arm, inputs, settings, batches):
            rates.append(settings.lr)
            super().__init__(arm, inputs, settings, batches)

        def update(self, data):
            pass

    monkeypatch.setitem(TASKS, "hike", replace(task, agent=Noted))
    monkeypatch.setattr("benchmarks.control.run.RATES", {("hike", "truth"): 3.0})
    tiny = {"env_steps": 32 * 75, "tests": 1, "episodes": 1}
    run("hike", (0.0, 0.0), "truth", 0, Budget(**tiny, rate=0.3))
    run("hike", (0.0, 0.0), "truth", 0, Budget(**tiny))
    run("hike", (0.0, 0.0), "last reading", 0, Budget(**tiny))
    assert rates == pytest.approx([0.3 * task.settings.lr, 3 * task.settings.lr, task.settings.lr])


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


def test_a_search_runs_all_first_rates_then_the_further_one_and_goes_on_where_it_was_broken_off(search, tmp_path):
    planned = [(task, arm) for task in CELLS for arm in ARMS if (task, arm) != ("pendulum", "Kalman")]
    first = {
        (task, CELLS[task], arm, seed, Budget(tests=1, rate=rate))
        for task, arm in planned
        for seed in (100, 101)
        for rate in (0.3, 1.0, 3.0)
    }
    further = {(task, CELLS[task], "GRU", seed, Budget(tests=1, rate=10.0)) for task in CELLS for seed in (100, 101)}
    begun = search("--seeds", "2", runs=50)
    between = search("--seeds", "2", runs=len(first) - 50)  # before any of the further rate
    assert len(begun + between) == len(first)
    assert set(begun + between) == first
    within = search("--seeds", "2", runs=1)
    assert search("--seeds", "0") == []
    assert "| GRU | 2 | 0.3 | 1.0 | **3.0** |" in (tmp_path / "search.md").read_text()  # no 10 yet: it has one seed
    rest = search("--seeds", "2")
    assert len(within + rest) == len(further)
    assert set(within + rest) == further
    assert search("--seeds", "2") == search("--seeds", "0") == []
    text = (tmp_path / "search.md").read_text()
    assert text.count("| GRU | 2 | 0.3 | 1.0 | 3.0 | **10.0** |") == 2
    assert text.count("| LSTM | 2 | 9.3 | **10.0** | 8.0 |  |") == 2
    written = COLUMNS.read(tmp_path / "search.csv")
    runs = {
        (row["task"], CELLS[row["task"]], row["arm"], row["seed"], Budget(tests=1, rate=row["rate"])) for row in written
    }
    assert runs == first | further
    assert all(row["return"] == (row["rate"] if row["arm"] == "GRU" else 10 - abs(row["rate"] - 1)) for row in written)


def test_rates_are_compared_with_the_same_seeds(search):
    """Seed 102 has no run at the third rate, and the further rate not all of the seeds that count."""
    tried = rows({0.3: [1.0, 2.0, 90.0], 1.0: [3.0, 4.0, 90.0], 3.0: [5.0, 6.0], 10.0: [99.0]})
    other = rows({0.3: [1.0], 1.0: [2.0], 3.0: [3.0], 10.0: [4.0]}, "GRU")
    assert complete(tried + other) == rows({0.3: [1.0, 2.0], 1.0: [3.0, 4.0], 3.0: [5.0, 6.0]}) + other
    search("--seeds", "1", runs=2)  # the LSTM at two rates
    with pytest.raises(SystemExit, match="no seed with which an arm ran at all of the first rates"):
        search("--seeds", "0")


def test_a_damaged_file_is_named(tmp_path, search):
    search("--seeds", "1", "--tasks", "hike")
    (tmp_path / "parts" / "hike" / "GRU-10-100.json").write_text('[{"task": "hi')
    with pytest.raises(ValueError, match=r"GRU-10-100.json is damaged .*remove it"):
        search("--seeds", "0")


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(SystemExit, match="holds no run"):
        found(Search(out=tmp_path))


def test_the_committed_search_is_what_the_study_takes():
    """The rates in tasks.py are those that are best in the committed rows; belief's variants have the belief's."""
    tried = COLUMNS.read(Path(protocol.__file__).parent / "results" / "search.csv")
    assert complete(tried) == tried
    assert {row["seed"] for row in tried} == {FIRST, FIRST + 1, FIRST + 2}
    chosen = {}
    for task in CELLS:
        arms = {row["arm"] for row in tried if row["task"] == task}
        chosen |= {(task, arm): best(tried, task, arm) for arm in arms}
        variants = set(study.READERS[task]) - arms
        assert set(BELIEFS[1:]) <= variants
        chosen |= {(task, arm): best(tried, task, "belief mean") for arm in variants}
    assert {key: rate for key, rate in chosen.items() if rate != 1} == RATES
