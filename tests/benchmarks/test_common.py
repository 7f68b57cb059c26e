"""What the studies share: options, jobs that are done once, rows that survive their file."""

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.arms.study import Study as Arms
from benchmarks.arms.study import run_study
from benchmarks.common.arguments import ROOT, command, parse, run_one
from benchmarks.common.jobs import once, read_rows, same_settings, side_by_side
from benchmarks.common.tables import Columns, head, line, pick
from benchmarks.kitti.study import Study as KITTI
from benchmarks.ur5.study import Study as UR5


def test_options_of_the_kitti_study():
    study = parse(KITTI, ["--root", "KITTI", "--drives", "00", "02", "--filters", "dekf", "--size", "100", "300"])
    assert (study.command, study.root, study.drives, study.filters) == ("table", Path("KITTI"), ("00", "02"), ("dekf",))
    assert (study.size, study.seeds, study.out) == ((100, 300), 1, Path("runs/kitti"))
    study = parse(KITTI, ["frontier", "--first", "a", "--sensor", "7", "--fine-tuning", "8", "--end-to-end", "9"])
    assert (study.command, study.first) == ("frontier", Path("a"))
    budget = study.budget
    assert (budget.sensor, budget.fine_tuning, budget.filter, budget.end_to_end, budget.length) == (7, 8, 300, 9, 24)


def test_options_of_the_ur5_study(capsys):
    study = parse(UR5, ["collect", "--processes", "2", "--trainings", "sim", "--seeds", "0", "3", "--motion", "5"])
    assert (study.command, study.processes, study.trainings, study.seeds) == ("collect", 2, ("sim",), (0, 3))
    assert (study.root, study.demos, study.budget.motion, study.budget.batch) == (Path("runs/ur5-demos"), 2000, 5, 12)
    with pytest.raises(SystemExit):
        parse(UR5, ["--filters", "nonsense"])
    assert "nonsense" in capsys.readouterr().err


@pytest.mark.parametrize("file", ["benchmarks.study.search", "benchmarks.study.search.__main__"])
def test_a_study_is_called_as_it_was_run(file, capsys, monkeypatch):
    @dataclass
    class Options:
        """Finds."""

        __module__ = "__main__"
        seeds: int = 1

    monkeypatch.setattr(sys.modules["__main__"], "__spec__", SimpleNamespace(name=file))
    with pytest.raises(SystemExit):
        parse(Options, ["--help"])
    assert "usage: python -m benchmarks.study.search [" in capsys.readouterr().out


def test_the_command_for_the_record_names_no_folder_of_the_machine(monkeypatch):
    data, out = ROOT.parent / "shared/data/kitti", ROOT / "runs/monitor"
    monkeypatch.setattr(sys, "argv", ["monitor", "--root", str(data), f"--out={out}", "--tasks", "car", "--draws", "3"])
    assert command("monitor") == (
        "python -m benchmarks.monitor --root ../shared/data/kitti --out=runs/monitor --tasks car --draws 3"
    )


def test_smoke_alone_runs_all_commands():
    called = []

    @dataclass
    class Count:
        """Counts."""

        number: int = 1
        smoke: bool = False

        def __call__(self):
            called.append((self.number, self.smoke))

    commands = {"first": Count, "second": Count}
    run_one(commands, ["--smoke"])
    assert called == [(1, True), (1, True)]
    run_one(commands, ["second", "--number", "5"])
    assert called[2:] == [(5, False)]


def test_a_job_is_done_once_and_leaves_nothing_half(tmp_path):
    file, calls = tmp_path / "rows" / "a.json", []

    def rows(fails):
        calls.append(fails)
        if fails:
            raise KeyboardInterrupt
        return [{"value": 1.5}]

    with pytest.raises(KeyboardInterrupt):
        once(file, partial(rows, True))
    assert not file.exists()
    once(file, partial(rows, False))
    once(file, partial(rows, False))
    assert calls == [True, False]
    assert read_rows([file]) == [{"value": 1.5}]
    file.write_text(file.read_text()[:-4])
    with pytest.raises(ValueError, match=r"a\.json is damaged .* remove it"):
        read_rows([file])


@pytest.mark.parametrize("processes", [1, 2])
def test_calls_side_by_side(tmp_path, processes):
    files = [tmp_path / name for name in "abc"]
    side_by_side([partial(Path.write_text, file, file.name) for file in files], processes, "files")
    assert [file.read_text() for file in files] == ["a", "b", "c"]
    with pytest.raises(FileNotFoundError):
        side_by_side([partial(Path.read_text, tmp_path / "no")], processes, "files")


def test_shared_rows_are_the_first_files(tmp_path):
    for name, value in (("a", 1), ("b", 2)):
        rows = [{"filter": "own", "value": value}, {"filter": "floor", "value": 10 * value}]
        (tmp_path / f"{name}.json").write_text(json.dumps(rows))
    found = read_rows(sorted(tmp_path.glob("*.json")), lambda row: row["filter"] if row["filter"] == "floor" else None)
    assert [row["value"] for row in found] == [1, 10, 2]


def test_a_folder_has_the_settings_it_was_begun_with(tmp_path):
    """The same again, tuples and paths among them, is no change; what changed is named, and what is there stays."""
    same_settings(tmp_path, {"seed": 0, "size": (1, 2), "root": Path("a")})
    same_settings(tmp_path, {"seed": 0, "size": (1, 2), "root": Path("a")})
    with pytest.raises(SystemExit, match=r"begun with seed=0 \(now 1\)\. Give another --out"):
        same_settings(tmp_path, {"seed": 1, "size": (1, 2), "root": Path("a")})
    with pytest.raises(SystemExit, match=r"root='a' \(now None\)"):
        same_settings(tmp_path, {"seed": 0, "size": (1, 2)})


def test_the_arms_study_does_not_answer_for_another_seed(tmp_path):
    """Nor for other settings: what a folder holds is of those that it was begun with; further tasks may come."""
    run_study(Arms(out=tmp_path, tasks=(), seed=0))
    run_study(Arms(out=tmp_path, tasks=(), seed=0, sources=("pixels",)))
    for other in ({"seed": 1}, {"demos": 8}):
        with pytest.raises(SystemExit, match=next(iter(other))):
            run_study(Arms(out=tmp_path, tasks=(), **other))


def test_another_tables_file_is_refused(tmp_path):
    columns = Columns(("name", "seed"), text=["name"], whole=["seed"], order=lambda row: row["seed"])
    for text in ("", "name\na\n", "name,seed,more\na,1,2\n"):
        (tmp_path / "table.csv").write_text(text)
        with pytest.raises(ValueError, match=r"table\.csv has .*not the columns name, seed"):
            columns.read(tmp_path / "table.csv")


def test_rows_survive_their_file_sorted_and_with_five_digits(tmp_path):
    columns = Columns(("name", "seed", "error"), text=["name"], whole=["seed"], order=lambda row: row["seed"])
    rows = [{"name": "b", "seed": 2, "error": float("nan")}, {"name": "a", "seed": 1, "error": 1 / 3}]
    columns.write(rows, tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_text() == "name,seed,error\na,1,0.33333\nb,2,\n"
    assert columns.read(tmp_path / "table.csv") == [
        {"name": "a", "seed": 1, "error": 0.33333},
        {"name": "b", "seed": 2},
    ]
    assert pick(rows, name="a") == rows[1:]
    assert [*head("a", 5), line(1, "x")] == ["| a | 5 |", "|---|---|", "| 1 | x |"]
