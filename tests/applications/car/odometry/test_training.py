"""A training leaves a filter that predicts better than before; a broken one continues to the same weights."""

import csv
import shutil

import pytest
import torch

from tests.applications.car.conftest import OPTIONS, SIZE
from torch_denkf.applications.car.odometry.evaluation import evaluate_car_filter
from torch_denkf.applications.car.odometry.roles import assign_roles
from torch_denkf.applications.car.odometry.streams import Drive, all_frames, read_spans
from torch_denkf.applications.car.odometry.training import train_car_filter
from torch_denkf.cli.main import main
from torch_denkf.training import FilterTrainer


def test_roles_are_disjoint_and_cover_all_drives():
    for count in range(1, 25):
        names = [f"{n:02d}" for n in range(count)]
        roles = assign_roles(names)
        assert sorted(name for part in roles.values() for name in part) == names
    assert [len(part) for part in assign_roles([str(n) for n in range(20)]).values()] == [2, 5, 13]
    assert assign_roles(["a"]) == {"validation": [], "filter": ["a"], "sensor": []}


class Killed(Exception):
    """As if the process had ended."""


@pytest.mark.slow  # tests/training/test_resume.py kills a training in all its stages
@pytest.mark.parametrize("stage", ["filter", "end_to_end"])
def test_killed_training_resumes_to_equal_weights(stage, root, trained, tmp_path, monkeypatch):
    shutil.copytree(trained[0] / "cache", tmp_path / "cache")  # the optical flow
    plain = FilterTrainer._update

    def update(self, number, updates, made, bar):
        if updates.stage.name == stage and made == 2:
            raise Killed
        plain(self, number, updates, made, bar)

    monkeypatch.setattr(FilterTrainer, "_update", update)
    with pytest.raises(Killed):
        train_car_filter(tmp_path, root=root, **OPTIONS)
    assert not (tmp_path / "weights.safetensors").exists()
    monkeypatch.setattr(FilterTrainer, "_update", plain)
    torch.manual_seed(99)  # what came before does not matter
    resumed = train_car_filter(tmp_path, root=root, **OPTIONS)
    for name, value in trained[1].state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    assert resumed.inflation == trained[1].inflation


def test_evaluation_against_the_floor(trained, root, tmp_path, capsys):
    folder, car = trained
    options = {"cache": folder / "cache", "draws": 2, "window": 10, "progress": False}
    rows, beliefs = evaluate_car_filter(car, root, ["b", "c"], **options)
    assert [(row["drive"], row["method"]) for row in rows[:3]] == [
        ("b", "filter"),
        ("b", "dead reckoning"),
        ("b", "floor"),
    ]
    floor = rows[2]
    assert floor["translation_m_per_m"] < 1e-3  # chords of arcs of 0.1 s
    assert rows[0]["translation_m_per_m"] > floor["translation_m_per_m"]
    assert 0 <= rows[0]["coverage90_v"] <= 1
    assert rows[0]["blind"] == 0
    # Dead reckoning is the readings' mean, integrated.
    data = [Drive(root, "b", SIZE, folder / "cache", two_view=True).read()]
    velocity = all_frames(read_spans(car.sensor, data, 3))["sensor", "ensemble"].mean(1)
    assert beliefs["b"]["sensor", "ensemble"].mean(1) == pytest.approx(velocity)
    missing, _ = evaluate_car_filter(car, root, ["b"], **options, missing=0.5)
    assert missing[0]["blind"] > 0.3
    with pytest.raises(ValueError, match=r"missing is in \[0, 1\)"):
        evaluate_car_filter(car, root, ["b"], missing=1.0)

    out = tmp_path / "evaluation"
    shutil.copytree(folder / "cache", out / "cache")  # the optical flow
    words = ["--drives", "b", "c", "--draws", "2", "--window", "10", "--out", str(out)]
    assert main(["evaluate", "--checkpoint", str(folder), "--root", str(root), *words]) == 0
    table = capsys.readouterr().out
    mean = (rows[0]["translation_m_per_m"] + rows[3]["translation_m_per_m"]) / 2
    assert f"| mean of 2 | filter | 10 | {mean:.4f}" in table
    assert table.splitlines()[2] in (out / "evaluation.md").read_text()
    with (out / "evaluation.csv").open() as stream:
        found = [(row["method"], float(row["translation_m_per_m"])) for row in csv.DictReader(stream)]
    assert found == [(row["method"], row["translation_m_per_m"]) for row in rows]
