"""Rows of a committed table that stand for their runs."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.control import study
from benchmarks.control.run import Budget, planned_tests, run
from benchmarks.control.shift import SHIFTED
from benchmarks.control.study import Study, complete, jobs, part
from benchmarks.control.tasks import TASKS


def test_known_rows_are_not_run_again(tmp_path):
    """The committed table stands for its runs: each has its rows again, and what it says does not change."""
    table = Path(study.__file__).parent / "results" / "control.csv"
    found = Study(out=tmp_path)
    lines = table.read_text().splitlines()
    few = [lines[0], *(line for line in lines[1:] if line.split(",")[-4] == "0" or line.startswith("cartpole"))]
    (tmp_path / "few.csv").write_text("\n".join(few) + "\n")
    study.keep(found, tmp_path / "few.csv", Budget())
    made = {job.args[0] for seed in range(5) for job in jobs(found, seed, Budget()) if job.args[0].exists()}
    assert made == set((tmp_path / "parts").rglob("*.json"))
    assert all(job.args[0].exists() for job in jobs(found, 0, Budget()))
    study.COLUMNS.write(complete(found), tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_text() == (tmp_path / "few.csv").read_text()
    one = json.loads(part(found, "cartpole", (0.1, 0.0), "LSTM", 3).read_text())
    assert {row["cell"] for row in one} == {"noise 0.1", SHIFTED.format("noise 0.3")}  # an LSTM has no R
    part(found, "hike", (0.4, 0.0), "LSTM", 0).write_text("[]")
    study.keep(found, tmp_path / "few.csv", Budget())
    assert part(found, "hike", (0.4, 0.0), "LSTM", 0).read_text() == "[]"  # what has run is not overwritten


def known(tmp_path, lines):
    (tmp_path / "known.csv").write_text("\n".join([",".join(study.COLUMNS.names), *lines]) + "\n")
    study.keep(Study(out=tmp_path), tmp_path / "known.csv", Budget())
    return len(list(tmp_path.rglob("*.json")))


def lines_of(task, cell, arm):
    """Rows of a run with seed 0, as the table has them."""
    return [f'{task},"{name}",{arm},0,{steps},1.0,2.0' for name, steps in planned_tests(task, cell, arm, Budget())]


def test_rows_of_whole_runs_alone_are_known(tmp_path):
    """Half a run, two of one, a cell, arm, seed or column that the study has not: refused, and named."""
    pole, hike = lines_of("cartpole", (0.1, 0.0), "physics"), lines_of("hike", (0.4, 0.0), "LSTM")
    assert (len(pole), len(hike)) == (7, 5)
    refused = {
        "LSTM, seed 0 is not whole": hike[:4],
        "physics, seed 0 is not whole": pole[:5],
        "noise 0.3, not trained, physics": pole[5:],
        "twice": [*hike, *hike],
        "hike, noise 0.5, LSTM, seed 0 is no run": [one.replace("0.4", "0.5") for one in hike],
        "GRU, seed 0 is no run": lines_of("hike", (0.8, 0.0), "GRU"),
        "seed 100 is no run": [one.replace(",0,", ",100,") for one in hike],
        "walker": [one.replace("hike", "walker") for one in hike],
        "something is missing": [*hike[:4], hike[4].replace(",1.0,", ",,")],
        "no rows": [],
    }
    for message, lines in refused.items():
        with pytest.raises(SystemExit, match=message):
            known(tmp_path, lines)
    (tmp_path / "known.csv").write_text("task,cell\n")
    with pytest.raises(SystemExit, match="not the columns task, cell, arm"):
        study.keep(Study(out=tmp_path), tmp_path / "known.csv", Budget())
    assert known(tmp_path, [*pole, *hike]) == 2


def test_a_run_has_the_tests_that_were_planned(monkeypatch):
    """What :func:`planned_tests` says, a tiny run does, where the noise changes afterwards and where it does not."""
    pole = TASKS["cartpole"]
    monkeypatch.setitem(TASKS, "hike", replace(TASKS["hike"], count=4))
    monkeypatch.setitem(TASKS, "cartpole", replace(pole, count=2, settings=replace(pole.settings, every=500)))
    for task, cell, arm in (("hike", (0.4, 0.0), "last reading"), ("cartpole", (0.1, 0.0), "four readings")):
        batch = TASKS[task].count * TASKS[task].steps
        budget = Budget(env_steps=3 * batch, tests=2, episodes=2, members=4, updates=0.02, every=2000)
        rows = run(task, cell, arm, 0, budget)
        assert [(row["cell"], row["env_steps"]) for row in rows] == planned_tests(task, cell, arm, budget)


def test_no_two_cells_share_the_name_of_a_test(monkeypatch):
    """Not even where the noise rises after the training in both; each row is found to be of its own cell."""
    cells = [(0.1, 0.0), (0.1, 0.3), (0.2, 0.0)]
    monkeypatch.setitem(study.CELLS, "cartpole-full", cells)
    names = [{name for name, _ in planned_tests("cartpole-full", cell, "physics", Budget())} for cell in cells]
    assert [len(each) for each in names] == [3, 3, 1]
    assert len(set.union(*names)) == 7
    for cell, each in zip(cells, names, strict=True):
        assert {study._trained("cartpole-full", name) for name in each} == {cell}


def test_a_smoke_run_knows_of_no_others(monkeypatch):
    monkeypatch.setattr("sys.argv", ["control", "--smoke", "--known", "control.csv"])
    with pytest.raises(SystemExit, match="leave --known out"):
        study.main()
