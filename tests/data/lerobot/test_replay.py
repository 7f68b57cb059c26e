"""Rows of recordings in LeRobot's layouts are what was written, and what torchrl's samplers ask for."""

import builtins
import json
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from torchrl.data.datasets import BaseDatasetExperienceReplay

from tests.data import replay_for_tests as shared
from tests.data.lerobot.lerobot_folder import (
    NAMES,
    SIZE,
    actions,
    joints,
    pictures,
    write_info,
    write_version_2,
    write_version_3,
)
from torch_denkf.data import LeRobotReplay

LENGTHS = [9, 6, 12, 7, 8]
open_all = partial(LeRobotReplay, size=SIZE, cache=None, split="all")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lerobot")
    write_version_2(folder, LENGTHS)
    return folder


def expected_pixels(episode, length, size=SIZE):
    frames = pictures(episode, length)
    if size != SIZE:
        frames = np.stack([cv2.resize(frame, size[::-1], interpolation=cv2.INTER_AREA) for frame in frames])
    return torch.from_numpy(frames.transpose(0, 3, 1, 2).astype(np.float32) / 255)


def check_rows(data, lengths, tolerance=0.0):
    rows = data[:]
    assert [(e.number, e.length) for e in data.episodes] == list(enumerate(lengths))
    assert len(data) == sum(lengths)
    for episode in data.episodes:
        mine, length = rows[episode.start : episode.start + episode.length], episode.length
        torch.testing.assert_close(mine["pixels"], expected_pixels(episode.number, length), rtol=0, atol=tolerance)
        assert (mine["state"].numpy() == joints(episode.number, length)).all()
        assert (mine["action"].numpy() == actions(episode.number, length)).all()
        np.testing.assert_allclose(mine["time"].flatten(), np.arange(length) / 10, atol=1e-7)  # float32 in the file
        assert mine["observed"].all()
    shared.check_contract(data)


# What is read ---------------------------------------------------------------------------------------------------------


def test_version_2_with_lossless_video(root):
    data = open_all(root)
    assert isinstance(data, BaseDatasetExperienceReplay)
    check_rows(data, LENGTHS)
    assert data.fps == 10
    assert data.names == tuple(NAMES)
    shared.check_indices(data)


@pytest.mark.parametrize("images", ["bytes", "path", "folder"])
def test_images_instead_of_video(tmp_path, images):
    write_version_2(tmp_path, LENGTHS[:3], images=images)
    check_rows(open_all(tmp_path), LENGTHS[:3])


def test_version_3_puts_many_episodes_in_a_file(tmp_path):
    """Data files and videos end at different episodes."""
    write_version_3(tmp_path, [[5, 7, 6], [4, 9]], groups_of_videos=[[5], [7, 6, 4, 9]])
    check_rows(open_all(tmp_path), [5, 7, 6, 4, 9])


def test_frames_follow_the_clock_and_not_the_count(tmp_path):
    """A camera of twice the rate; rows in a file are not in the order of their times."""
    write_version_2(tmp_path, [6])
    video = tmp_path / "videos/chunk-000/observation.images.top/episode_000000.mkv"
    writer = cv2.VideoWriter(str(video), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), 20, SIZE[::-1])
    for frame in pictures(0, 6):
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
        writer.write(np.zeros((*SIZE, 3), np.uint8))  # half way between two rows
    writer.release()
    check_rows(open_all(tmp_path), [6])


# Splits, samples, statistics ------------------------------------------------------------------------------------------


def test_statistics_by_numpy(root):
    data = LeRobotReplay(root, size=SIZE, cache=None)  # the training split
    which = [e.number for e in data.episodes]
    assert len(which) == 4
    shared.check_statistics(
        data.statistics,
        state=np.concatenate([joints(e, LENGTHS[e]) for e in which]),
        action=np.concatenate([actions(e, LENGTHS[e]) for e in which]),
        pixels=np.concatenate([pictures(e, LENGTHS[e]) for e in which]).reshape(-1, 3) / 255,
    )
    assert data.statistics["pixels", "mean"].shape == (3, 1, 1)
    assert data.statistics["state", "std"][2] == 0  # a joint that never moves
    everything = open_all(root)  # its statistics are those of the training episodes, too
    assert (everything.statistics == data.statistics).all()
    assert abs(everything[:]["state"][:, 0].mean() - data.statistics["state", "mean"][0]) > 0.01


# Cache and bar --------------------------------------------------------------------------------------------------------


# What is optional -----------------------------------------------------------------------------------------------------


def without(monkeypatch, *names):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.split(".")[0] in names:
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)


def test_without_the_extra(tmp_path, root, monkeypatch):
    write_version_2(tmp_path, [4], codec="av1", suffix="mp4")
    with monkeypatch.context() as patch:
        without(patch, "av")
        with pytest.raises(ValueError, match=r"no frame of .*episode_000000.mp4 .*AV1 .*torch_denkf\[lerobot\]"):
            open_all(tmp_path)
        check_rows(open_all(root), LENGTHS)  # other codecs need no PyAV
    with monkeypatch.context() as patch:
        without(patch, "pyarrow")
        with pytest.raises(ImportError, match=r"pyarrow: pip install 'torch_denkf\[lerobot\]'"):
            open_all(root)


@pytest.mark.parametrize("dims", [[2, 0], ["wrist", "shoulder"], ["wrist", 0]])
def test_some_numbers_of_the_state(root, dims):
    data, whole = open_all(root, dims=dims, action_dims=[1]), open_all(root)
    assert data.names == ("wrist", "shoulder")
    assert data[:]["state"].equal(whole[:]["state"][:, [2, 0]])
    assert data[:]["action"].equal(whole[:]["action"][:, [1]])
    assert data.statistics["state", "std"].equal(whole.statistics["state", "std"][[2, 0]])
    assert whole.names == tuple(NAMES)
    shared.check_contract(data)


def test_names_and_actions_are_optional(tmp_path):
    write_version_2(tmp_path, [4], images="bytes")
    info = json.loads((tmp_path / "meta/info.json").read_text())
    for names, expected in (
        (NAMES, tuple(NAMES)),
        ({"motors": NAMES[:2], "gripper": ["g"]}, ("shoulder", "elbow", "g")),
        ([NAMES], tuple(NAMES)),  # as Unitree's converter writes them
        (["motors"], None),
        (None, None),
    ):
        info["features"]["observation.state"]["names"] = names
        write_info(tmp_path, "v2.1", False, features=info["features"])
        assert open_all(tmp_path).names == expected
    del info["features"]["action"]
    write_info(tmp_path, "v2.1", False, features=info["features"])
    assert "action" not in open_all(tmp_path)[:]
    assert "action" not in open_all(tmp_path).statistics
