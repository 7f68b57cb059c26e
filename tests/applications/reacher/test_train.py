"""The program that trained the reacher's filter runs, leaves a folder that loads, and scores what its card says."""

import json

import pytest
import torch

from torch_denkf import from_pretrained
from torch_denkf.applications.reacher.commands import TrainReacher
from torch_denkf.applications.reacher.train import evaluate_reacher, train_reacher


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
    assert TrainReacher.main(["--out", str(tmp_path), "--evaluate"]) == 0
    scores = json.loads(capsys.readouterr().out)
    assert scores["rates, RMSE rad/s"]["filter"] == pytest.approx(0.40, abs=0.02)
    assert scores["angles, RMSE rad"]["filter"] == pytest.approx(0.040, abs=0.002)
    assert scores["held by 90 % intervals"] == pytest.approx(0.90, abs=0.02)
