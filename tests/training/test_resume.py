"""Killed with SIGKILL and started again: every file is that of a training that was never interrupted."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.training.killed_runs import KILLS
from tests.training.problem import make_trainer
from torch_denkf.training import FilterTrainer, Stage
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    command = [sys.executable, "-m", "tests.training.killed_runs", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder


def csv_files(run):
    folder = run / "logs" / "csv"
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*.csv")}


def assert_same(one, other, where=""):
    """Nested containers of tensors and plain values, bit for bit."""
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
    if isinstance(one, dict | list | tuple):
        assert len(one) == len(other), where
        for key in one if isinstance(one, dict) else range(len(one)):
            assert_same(one[key], other[key], f"{where}[{key!r}]")
    elif isinstance(one, torch.Tensor):
        assert torch.equal(one, other), where
    else:
        assert one == other, where


@pytest.mark.parametrize("name", KILLS)
def test_killed_and_resumed_is_unbroken(runs, name):
    run, unbroken = runs / name, runs / ("unbroken_two" if name == "two_processes" else "unbroken")
    logs = csv_files(unbroken)
    assert len(logs) == 7 + 8 + 10  # terms, loss, grad_norm, lr, skipped, length, two errors
    assert csv_files(run) == logs
    for file in ("last.pt", "best_sensor.pt", "best_filter.pt", "best_end_to_end.pt"):
        one, other = read_checkpoint(run / file), read_checkpoint(unbroken / file)
        for content in (one, other):
            content.pop("logs", None)  # the names of tensorboard's files have the time in them
        assert_same(one, other, file)
    assert_same(torch.load(run / "final_0.pt"), torch.load(unbroken / "final_0.pt"))


@pytest.mark.parametrize("name", ["after_rows_that_no_checkpoint_knows", "twice_in_the_last_stage"])
def test_tensorboard_shows_every_value_once(runs, name):
    shown = []
    for run in (runs / "unbroken", runs / name):
        events = EventAccumulator(str(run / "logs" / "tensorboard")).Reload()
        tags = events.Tags()["scalars"]
        # Sorted, as two processes that start in one second are read in the order of their numbers' spelling.
        shown.append({tag: sorted((event.step, event.value) for event in events.Scalars(tag)) for tag in tags})
    assert shown[0] == shown[1]
    rows = csv_files(runs / "unbroken")["scalars/filter/validation/mse.csv"].decode().split()
    expected = [(int(step), pytest.approx(float(value), rel=1e-6)) for step, value in (row.split(",") for row in rows)]
    assert shown[0]["filter/validation/mse"] == expected  # tensorboard has single precision
    assert [step for step, _ in expected] == [0, 2, 4, 5]


def test_processes_stay_equal_and_differ_from_one(runs):
    first, second, one = (
        torch.load(runs / file)
        for file in ("unbroken_two/final_0.pt", "unbroken_two/final_1.pt", "unbroken/final_0.pt")
    )
    assert_same(first, second)
    assert any(not torch.equal(first[name], one[name]) for name in one)  # it has seen other batches


def test_a_finished_training_is_not_trained_again(tmp_path):
    first = make_trainer(tmp_path, updates=2).fit()
    after = torch.rand(3)
    logs, trainer = csv_files(tmp_path), make_trainer(tmp_path, updates=2)
    trainer.register_op("pre_optim_steps", lambda: pytest.fail("trained again"))
    assert trainer.fit() == first
    assert torch.equal(torch.rand(3), after)  # make_trainer seeds; what follows draws the same numbers
    assert csv_files(tmp_path) == logs
    assert_same(dict(trainer.model.state_dict()), dict(torch.load(first["end_to_end"]["path"])["model"]))


def test_settings_must_be_the_same_and_stages_may_be_added(tmp_path, caplog):
    two = make_trainer(tmp_path, updates=2, stages=("sensor", "filter")).fit()
    with pytest.raises(ValueError, match=r"last\.pt is of another training: seed \(0, now 3\), stages\[0\].updates"):
        make_trainer(tmp_path, updates=3, seed=3).fit()
    three = make_trainer(tmp_path, updates=2).fit()
    assert list(three) == ["sensor", "filter", "end_to_end"]
    assert {name: three[name] for name in two} == two
    assert "fit(resume=False)" not in caplog.text
    make_trainer(tmp_path, updates=2).fit()
    assert "fit(resume=False)" in caplog.text, "all is done"
    logs = csv_files(tmp_path)
    make_trainer(tmp_path, updates=2, seed=1).fit(resume=False)
    again = csv_files(tmp_path)
    assert again.keys() == logs.keys()
    assert again["scalars/filter/loss.csv"] != logs["scalars/filter/loss.csv"]
    assert again["scalars/filter/loss.csv"].count(b"\n") == 1


def test_another_model_raises(tmp_path):
    def trainer(width):
        net = torch.nn.Linear(width, 1)
        return FilterTrainer(net, [Stage("fit", None, None, 1)], out=tmp_path, device="cpu")

    state = {"settings": trainer(1)._settings, "stage": 1, "update": 0, "logs": {}, "best": None, "hooks": {}}
    state |= {"updates": None, "results": {}, "last_metrics": {}, "first": None, "model": trainer(1).model.state_dict()}
    write_checkpoint(tmp_path / "last.pt", state)
    with pytest.raises(ValueError, match=r"(?s)last\.pt does not fit the model.*size mismatch for weight"):
        trainer(2).fit()


def test_a_second_trainer_raises(tmp_path):
    locked = rf"cannot use .*run: another process is training in it \(process {os.getpid()}\); wait for it"
    trainer = make_trainer(tmp_path / "run", updates=2, stages=("sensor",))
    trainer.register_op("pre_optim_steps", make_trainer(tmp_path / "run", updates=2, stages=("sensor",)).fit)
    with pytest.raises(OSError, match=locked):
        trainer.fit()


@pytest.mark.parametrize("resume", [True, False])
def test_irreproducible_files_are_moved_and_not_deleted(tmp_path, resume, caplog):
    make_trainer(tmp_path, updates=2).fit()
    before = {file.name: file.read_bytes() for file in tmp_path.glob("best_*.pt")}
    logs = csv_files(tmp_path)
    for number in (1, 2):
        (tmp_path / "last.pt").unlink()
        make_trainer(tmp_path, updates=2, seed=1).fit(resume=resume)
        assert f"they are now in {tmp_path / f'earlier-{number}'}" in caplog.text
    assert {file.name: file.read_bytes() for file in (tmp_path / "earlier-1").glob("best_*.pt")} == before
    assert csv_files(tmp_path / "earlier-1") == logs
    assert len(before) == len(list((tmp_path / "earlier-2").glob("best_*.pt"))) == 3
