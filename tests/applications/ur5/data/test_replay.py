"""The data set's rows are the demo files' rows, whatever torchrl asks for; its figures are numpy's."""

from functools import partial

import numpy as np
import pytest
import torch
from torchrl.data.datasets import BaseDatasetExperienceReplay

from tests.applications.ur5.data.ur5_demos import LENGTHS, SIZE, make_demo, ten_demos
from tests.data import replay_for_tests as shared
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.simulation.names import TASKS

open_dataset = partial(UR5ExperienceReplay, cache=None)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return ten_demos(tmp_path_factory)


def test_all_rows(root):
    data = open_dataset(root, split="all")
    assert isinstance(data, BaseDatasetExperienceReplay)
    assert [e.length for e in data.episodes] == list(LENGTHS)
    assert [e.task for e in data.episodes] == [TASKS[k % 3] for k in range(10)]
    assert len(data) == sum(LENGTHS)
    rows = data[:]
    assert "frame" not in rows
    for number, episode in enumerate(data.episodes):
        demo = make_demo(episode.demo, episode.length)
        mine = rows[episode.start : episode.start + episode.length]
        assert (mine["state"].numpy() == demo.state).all()
        assert (mine["action"].numpy() == demo.action).all()
        assert (mine["success"].squeeze(-1).numpy() == demo.success).all()
        assert (mine["task"] == number % 3).all()
        np.testing.assert_allclose(mine["time"].flatten(), 0.08 * np.arange(episode.length), rtol=1e-12)
        assert mine["observed"].flatten().nonzero().flatten().tolist() == demo.steps.tolist()
        assert mine["pixels"].dtype == torch.float32
        pixels = np.zeros((episode.length, 3, *SIZE), np.float32)
        pixels[demo.steps] = demo.pixels.astype(np.float32) / 255
        assert (mine["pixels"].numpy() == pixels).all()
    shared.check_contract(data)
    shared.check_indices(data)


def test_statistics_are_of_the_training_demos_alone(root):
    train = [e.demo for e in open_dataset(root).episodes]
    demos = [make_demo(number, LENGTHS[number]) for number in train]
    state, action = (np.concatenate([getattr(demo, name) for demo in demos]) for name in ("state", "action"))
    pixels = np.concatenate([demo.pixels for demo in demos]).transpose(0, 2, 3, 1).reshape(-1, 3) / 255
    for split, frames_only in [("train", False), ("test", False), ("all", True)]:
        statistics = open_dataset(root, split=split, frames_only=frames_only).statistics
        shared.check_statistics(statistics, state=state, action=action, pixels=pixels)
    shape = tuple(statistics["pixels", "std"].shape)
    assert shape == (3, 1, 1)
