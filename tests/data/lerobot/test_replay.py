"""Rows of recordings in LeRobot's layouts are what was written, and what torchrl's samplers ask for."""

import builtins
import json
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from torchrl.data.datasets import BaseDatasetExperienceReplay

import torch_denkf.data.lerobot.recording as recording_module
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
from torch_denkf.data.cache_entry import CachedTensor

LENGTHS = [9, 6, 12, 7, 8]
TESTS = {4, 8, 11, 19, 24}  # of 25 episodes
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


# Neighbouring frames differ by 14/255 in red. Lossy codecs keep flat colours and soft ramps to within 6/255 (measured:
# 5 by MPEG-4, 4 by AV1): a frame in a neighbour's row fails.
LOSSY = 6 / 255


@pytest.mark.parametrize("codec", ["mp4v", "av1"])
def test_lossy_video(tmp_path, codec):
    write_version_2(tmp_path / "2", LENGTHS[:2], version="v2.0", codec=codec, suffix="mp4")
    check_rows(open_all(tmp_path / "2"), LENGTHS[:2], LOSSY)
    write_version_3(tmp_path / "3", [[5, 7], [6]], codec=codec, suffix="mp4")
    check_rows(open_all(tmp_path / "3"), [5, 7, 6], LOSSY)


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


def test_splits_are_by_episode_and_stay(tmp_path):
    write_version_2(tmp_path, [2] * 25, images="bytes")
    sets = {s: {e.number for e in open_all(tmp_path, split=s).episodes} for s in ("train", "test", "all")}
    assert len(sets["test"]) == 5
    assert not sets["train"] & sets["test"]
    assert sets["train"] | sets["test"] == sets["all"] == set(range(25))
    assert sets["test"] == TESTS  # these must never move: networks were trained on the others
    assert len({number % 5 for number in sets["test"]}) > 1  # not each fifth: recordings often go round objects
    test = open_all(tmp_path, split="test")
    for episode in test.episodes:
        mine = test[:][episode.start : episode.start + 2]
        assert mine["pixels"].equal(expected_pixels(episode.number, 2))
        assert (mine["state"].numpy() == joints(episode.number, 2)).all()
    lines = (tmp_path / "meta/episodes.jsonl").read_text().splitlines()
    (tmp_path / "meta/episodes.jsonl").write_text("\n".join(lines[:12]))  # as it was earlier
    fewer = {e.number for e in open_all(tmp_path, split="test").episodes}
    assert fewer == {number for number in sets["test"] if number < 12}
    (tmp_path / "meta/episodes.jsonl").write_text(next(lines[k] for k in range(5) if k not in sets["test"]))
    with pytest.raises(ValueError, match=r"none of the 1 episodes in .* is in the split 'test', .*pass split='all'"):
        open_all(tmp_path, split="test")


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


def test_the_second_open_reads_the_cache(root, tmp_path, monkeypatch):
    first = LeRobotReplay(root, size=SIZE, cache=tmp_path, split="all")
    assert len(list(tmp_path.iterdir())) == 1  # no temporary file stays
    with monkeypatch.context() as patch:
        patch.setattr(recording_module, "frames_at_times", None)
        patch.setattr(recording_module, "read_table", None)
        again = LeRobotReplay(root, size=SIZE, cache=tmp_path, split="all")
        parts = [LeRobotReplay(root, size=SIZE, cache=tmp_path, split=s) for s in ("train", "test")]
    assert isinstance(again._images.stores[0], CachedTensor)
    assert again._images.stores[0].dtype == torch.uint8
    assert "pixels" not in again._storage[:]
    assert (again[:] == first[:]).all()
    check_rows(again, LENGTHS)
    assert sum(len(part) for part in parts) == sum(LENGTHS)
    LeRobotReplay(root, size=(24, 32), cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_changed_files_are_read_anew(tmp_path):
    write_version_2(tmp_path / "a", [4, 4], images="folder")
    before = open_all(tmp_path / "a", cache=tmp_path / "cache")[:]["pixels"]
    name = tmp_path / "a/images/observation.images.top/episode_000001/frame_000002.png"
    cv2.imwrite(str(name), np.zeros((*SIZE, 3), np.uint8))
    after = open_all(tmp_path / "a", cache=tmp_path / "cache")[:]["pixels"]
    assert not after[6].any()
    assert after[[0, 1, 2, 3, 4, 5, 7]].equal(before[[0, 1, 2, 3, 4, 5, 7]])


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
