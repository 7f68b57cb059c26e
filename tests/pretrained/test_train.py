"""The programs that trained the filters run, leave a folder that loads, and score what they say."""

import json

import pytest
import torch

from tests.envs.opengl import needs_opengl
from torch_denkf import from_pretrained
from torch_denkf.pretrained.train.__main__ import main
from torch_denkf.pretrained.train.reacher import evaluate_reacher, train_reacher
from torch_denkf.pretrained.train.ur5_table import evaluate_ur5_table, train_ur5_table, whole_demos


def test_reacher(tmp_path):
    model = train_reacher(tmp_path, seed=1, updates=2, episodes=2, command="train", progress=False)
    again = from_pretrained(tmp_path)
    for name, value in model.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])
    training = json.loads((tmp_path / "config.json").read_text())["training"]
    assert training == {"command": "train", "seed": 1, "episodes": 2, "updates": 2}
    scores = evaluate_reacher(again, episodes=4, steps=200)
    assert scores["angles, RMSE rad"]["encoders"] == pytest.approx(0.05, rel=0.05)
    # White noise of two encoders, over a step of 0.02 s; the joints' own changes add little.
    assert scores["rates, RMSE rad/s"]["differences"] == pytest.approx(0.05 * 2**0.5 / 0.02, rel=0.05)


def test_the_filter_of_the_library_scores_as_its_card_says(tmp_path, capsys):
    assert main(["reacher", "--out", str(tmp_path), "--evaluate"]) == 0
    scores = json.loads(capsys.readouterr().out)
    assert scores["rates, RMSE rad/s"]["filter"] == pytest.approx(0.40, abs=0.02)
    assert scores["angles, RMSE rad"]["filter"] == pytest.approx(0.040, abs=0.002)
    assert scores["held by 90 % intervals"] == pytest.approx(0.90, abs=0.02)


def test_ur5_table(tmp_path):
    needs_opengl()
    few = {"demos": 12, "sequences": 10, "sensor_updates": 2, "filter_updates": 2, "progress": False}
    model = train_ur5_table(tmp_path, seed=1, **few)
    demos, cache = whole_demos(tmp_path, 10, progress=False), tmp_path / "cache"
    mine, loaded = (
        evaluate_ur5_table(each, demos, missing=0.3, cache=cache, progress=False)
        for each in (model, from_pretrained(tmp_path))
    )
    assert mine == loaded
    trained = evaluate_ur5_table(from_pretrained("ur5-table"), demos, cache=cache, progress=False)
    assert trained["filter"]["joints, deg"] < 1.2
    assert trained["filter"]["joints, deg"] < trained["last targets"]["joints, deg"]
    assert trained["filter"]["tool, cm"] < trained["sensor"]["tool, cm"]
