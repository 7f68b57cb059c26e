"""Recordings that contradict their metadata, are there in part, or hold numbers that float32 does not."""

import json
import warnings
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import torch
from torch.testing import assert_close

from benchmarks.reliability.damage import put
from benchmarks.reliability.documents import edited
from tests.data.lerobot.lerobot_folder import SIZE, actions, joints, pictures, write_version_2, write_version_3
from tests.data.lerobot.test_errors import edit_table
from torch_denkf.data import LeRobotReplay

open_all = partial(LeRobotReplay, size=SIZE, cache=None, split="all", progress=False)
VIDEO = "videos/chunk-{:03d}/observation.images.top/episode_{:06d}.mkv"


@pytest.fixture(autouse=True)
def _no_other_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


def edit_info(root, **changes):
    file = root / "meta/info.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def with_lengths(root, version, lengths):
    if version == 3:
        write_version_3(root, [lengths])
    else:
        write_version_2(root, lengths)


def test_an_episode_that_was_given_up(tmp_path):
    """It has neither rows nor files, or a file without its rows."""
    write_version_2(tmp_path, [4, 5, 3])
    edited(put((1, "length"), 0))(tmp_path / "meta/episodes.jsonl")
    (tmp_path / "data/chunk-000/episode_000001.parquet").unlink()
    assert [episode.number for episode in open_all(tmp_path).episodes] == [0, 2]


@pytest.mark.parametrize("name", ["actions", "observation.command", "motor_cmd"])
def test_commands_under_another_name(tmp_path, name):
    write_version_2(tmp_path, [4])
    info = json.loads((tmp_path / "meta/info.json").read_text())
    features = {name if key == "action" else key: one for key, one in info["features"].items()}
    edit_info(tmp_path, features=features)
    file = tmp_path / "data/chunk-000/episode_000000.parquet"
    edit_table(file, action=None, **{name: parquet.read_table(file)["action"]})
    with pytest.warns(UserWarning, match=rf"info.json: '{name}' is left out, and looks .* action_key='{name}'") as said:
        assert "action" not in open_all(tmp_path)[:]
    assert said[0].filename == __file__
    assert_close(open_all(tmp_path, action_key=name)[:]["action"], torch.from_numpy(actions(0, 4)))
    assert "action" not in open_all(tmp_path, action_key=None)[:]


@pytest.mark.parametrize("version", [2, 3])
def test_some_of_the_episodes(tmp_path, version):
    with_lengths(tmp_path, version, [3, 4, 5, 6, 3, 4, 5])
    everything, some = open_all(tmp_path), open_all(tmp_path, episodes=[5, 1, 2])
    assert [episode.number for episode in some.episodes] == [1, 2, 5]
    for episode in some.episodes:
        mine = some[episode.start : episode.start + episode.length]
        whole = everything.episodes[episode.number]
        theirs = everything[whole.start : whole.start + whole.length]
        for key in ("pixels", "state", "action", "time"):
            assert mine[key].equal(theirs[key])
    for split in ("train", "test"):
        found = {episode.number for episode in open_all(tmp_path, split=split).episodes}
        chosen = sorted(found & {1, 2, 5})
        if chosen:
            data = open_all(tmp_path, split=split, episodes=[1, 2, 5])
            assert [episode.number for episode in data.episodes] == chosen


def test_videos_that_are_missing(tmp_path):
    """All of them are told of at once, with the episodes that are whole, which can be read."""
    write_version_2(tmp_path, [3] * 7)
    for episode in (1, 2, 5):
        (tmp_path / VIDEO.format(episode // 2, episode)).unlink()
    (tmp_path / "data/chunk-001/episode_000003.parquet").unlink()
    with pytest.raises(
        FileNotFoundError,
        match=r"no .*episode_000001.mkv, .* nor 3 more of its files, such as .*episode_000002.mkv; .*: 0, 4, 6$",
    ):
        open_all(tmp_path)
    data = open_all(tmp_path, episodes=[0, 4, 6])
    assert_close(data[:]["state"], torch.from_numpy(np.concatenate([joints(episode, 3) for episode in (0, 4, 6)])))
    shown = np.concatenate([pictures(episode, 3) for episode in (0, 4, 6)]).transpose(0, 3, 1, 2)
    assert_close(data[:]["pixels"], torch.from_numpy(shown).float() / 255)


@pytest.mark.parametrize("cached", [False, True])
def test_large_numbers(tmp_path, cached):
    """Counts encoders up to 2.1e9: float32 swallows steps of 7; behind an origin they are there."""
    root = tmp_path / "robot"
    write_version_2(root, [40])
    file = root / "data/chunk-000/episode_000000.parquet"
    ticks = 7 * np.arange(120.0).reshape(40, 3)
    edit_table(file, **{"observation.state": pa.array(list(2.1e9 + ticks), pa.list_(pa.float64()))})
    options = {"cache": tmp_path / "cache" if cached else None}
    match = (
        r"episode_000000.parquet: 'shoulder' moves by 21 a row near 2100000\d+[.5]*, where float32 resolves 1.3e\+02"
    )
    with pytest.warns(UserWarning, match=match + r".*'wrist'.*; pass origin=\{'state': \.\.\.\}") as said:
        open_all(root, **options)
    assert len(said) == 1
    kept = open_all(root, **options, origin={"state": 2.1e9})[:]["state"]
    assert_close(kept, torch.from_numpy(ticks).float())
    near = open_all(root, **options, origin={"state": torch.tensor([2.1e9 + 1] * 3, dtype=torch.float64)})[:]["state"]
    assert_close(near, torch.from_numpy(ticks - 1).float())  # not another origin's entry of the cache
    each = open_all(root, **options, origin={"state": [2.1e9, 2.1e9 + 7, 2.1e9], "action": 1.0}, dims=[1])[:]
    assert_close(each["state"], torch.from_numpy(ticks - 7)[:, 1:2].float())
    assert_close(each["action"], torch.from_numpy(actions(0, 40) - 1))
