"""The data set's rows are the demo files' rows, whatever torchrl asks for; its figures are numpy's."""

from functools import partial

import numpy as np
import pytest
import torch
from torchrl.data.datasets import BaseDatasetExperienceReplay

from tests.applications.ur5.data.ur5_demos import LENGTHS, SIZE, make_demo, ten_demos, write_folder
from tests.data import replay_for_tests as shared
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.data import cache
from torch_denkf.applications.ur5.data.files import read_demo
from torch_denkf.applications.ur5.data.rows import is_for_tests
from torch_denkf.applications.ur5.simulation.names import TASKS
from torch_denkf.data.cache_entry import CachedTensor

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


def test_splits_are_by_demo(root, tmp_path):
    demos = {split: {e.demo for e in open_dataset(root, split=split).episodes} for split in ("train", "test", "all")}
    assert demos["train"] | demos["test"] == demos["all"] == set(range(10))
    assert demos["train"]
    assert demos["test"]
    assert not demos["train"] & demos["test"]
    # A fifth of 2,000 is 400; the standard deviation of a binomial draw is 18.
    tests = [number for number in range(2000) if is_for_tests(number)]
    assert abs(len(tests) - 400) < 54
    # These must never move: networks were trained on the others.
    assert tests[:6] == [9, 12, 15, 19, 26, 31]
    for task in range(3):
        assert abs(sum(number % 3 == task for number in tests) - 133) < 40
    fewer = write_folder(tmp_path, [make_demo(number, 5, size=(6, 8)) for number in (*tests[:3], 1)])
    assert {e.demo for e in open_dataset(fewer, split="test").episodes} == set(tests[:3])


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


def test_the_cache_is_read_and_follows_the_files(root, tmp_path, monkeypatch):
    folder, place = tmp_path / "demos", tmp_path / "cache"
    folder.mkdir()
    write_folder(folder, [make_demo(number, 8) for number in range(4)])
    decoded = []

    def count(*args):
        decoded.append(args)
        return read_demo(*args)

    monkeypatch.setattr(cache, "read_demo", count)
    first = UR5ExperienceReplay(folder, split="all", cache=place)
    assert len(decoded) == 1 + 4  # the first one also tells the size
    assert isinstance(first._frames["pixels"], CachedTensor)
    decoded.clear()
    for split in ("all", "train"):
        again = UR5ExperienceReplay(folder, split=split, cache=place)
    assert not decoded
    assert len(again) == 8 * len(again.episodes)
    fresh = UR5ExperienceReplay(folder, split="all", cache=None)
    assert (first[:] == fresh[:]).all()
    assert (UR5ExperienceReplay(folder, split="all", cache=place)[:] == fresh[:]).all()

    decoded.clear()
    write_folder(folder, [make_demo(number, 8) for number in range(5)])
    assert len(UR5ExperienceReplay(folder, split="all", cache=place).episodes) == 5
    assert decoded
    entries = sorted(place.iterdir())
    assert len(entries) == 2
    for entry in entries:  # damaged from outside: made again
        (entry / "meta.json").write_text("{")
    assert (UR5ExperienceReplay(folder, split="all", cache=place)[:32] == fresh[:]).all()

    monkeypatch.setattr(cache, "_rows", lambda *args: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        UR5ExperienceReplay(folder, size=(3, 4), cache=place)
    assert len(list(place.iterdir())) == 2  # nothing half-made stays
    monkeypatch.undo()
    assert len(UR5ExperienceReplay(folder, split="all", size=(3, 4), cache=place)) == 40
