"""Damaged recordings in LeRobot's layout: refused by file and entry, or kept as far as they are sound, and counted."""

import json
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import torch
from tensordict import TensorDict

from tests.borders.test_constructors import refused
from tests.data.lerobot.lerobot_folder import FPS, SIZE, joints, write_info, write_version_2, write_version_3
from tests.data.lerobot.test_errors import edit_table
from torch_denkf.data import LeRobotReplay
from torch_denkf.data.lerobot.rows import recording_from_rows

open_all = partial(LeRobotReplay, size=SIZE, cache=None, split="all")
INFO, EPISODES = "meta/info.json", "meta/episodes.jsonl"
DATA = "data/chunk-000/episode_000000.parquet"
ROWS = 12


@pytest.fixture
def root(tmp_path):
    """Two episodes, of 12 rows and of 4."""
    write_version_2(tmp_path, [ROWS, 4], images="bytes")
    return tmp_path


def refuses(root, *words):
    refused(lambda: open_all(root), *words)


def edit_info(root, **changes):
    info = json.loads((root / INFO).read_text()) | changes
    (root / INFO).write_text(json.dumps({key: value for key, value in info.items() if value != "leave out"}))


INFOS = {
    "fps 0": ({"fps": 0}, "fps in", INFO, "got 0.0"),
    "fps -10": ({"fps": -10}, "fps in", INFO, "got -10.0"),
    "fps nan": ({"fps": float("nan")}, "fps in", INFO, "got nan"),
    "fps inf": ({"fps": float("inf")}, "fps in", INFO, "got inf"),
    "no fps": ({"fps": "leave out"}, INFO, "malformed", "'fps'"),
    "fps text": ({"fps": "fast"}, INFO, "malformed", "fast"),
    "no features": ({"features": "leave out"}, INFO, "malformed", "'features'"),
    "a feature without dtype": ({"features": {"x": {"shape": [1]}}}, INFO, "'x'", "'dtype'"),
    "a feature without shape": ({"features": {"x": {"dtype": "float32"}}}, INFO, "'x'", "'shape'"),
    "a feature that is a number": ({"features": {"x": 3}}, INFO, "'x'", "3"),
    "chunks of 0": ({"chunks_size": 0}, "chunks_size in", INFO, "got 0"),
    "chunks of -2": ({"chunks_size": -2}, "chunks_size in", INFO, "got -2"),
    "no data_path": ({"data_path": "leave out"}, INFO, "'data_path'", "None"),
    "data_path a number": ({"data_path": 3}, INFO, "'data_path'", "3"),
    "data_path of another": ({"data_path": "data/{part}.parquet"}, INFO, "'data_path'", "'part'"),
    "data_path of attributes": ({"data_path": "{episode_index.__class__.x}"}, INFO, "'data_path'", "__class__.x"),
    "data_path above": ({"data_path": "../{episode_index}.parquet"}, INFO, "'data_path'", "outside of the data set"),
    "data_path absolute": ({"data_path": "/etc/passwd"}, INFO, "'data_path'", "outside of the data set", "/etc/passwd"),
}


@pytest.mark.parametrize("case", INFOS.values(), ids=INFOS)
def test_metadata(root, case):
    changes, *words = case
    edit_info(root, **changes)
    refuses(root, *words)


LINES = {
    "twice": ('{"episode_index": 0, "length": 12}', EPISODES, "lists episode 0 twice"),
    "negative": ('{"episode_index": -1, "length": 12}', "episode_index in", f"{EPISODES}:3", "got -1"),
    "negative length": ('{"episode_index": 2, "length": -4}', "length in", f"{EPISODES}:3", "got -4"),
    "no length": ('{"episode_index": 2}', EPISODES, "line 3", "'length'"),
    "cut": ('{"episode_ind', EPISODES, "line 3", "malformed"),
    "a list": ("[2, 4]", EPISODES, "line 3", "malformed"),
}


@pytest.mark.parametrize("case", LINES.values(), ids=LINES)
def test_lines_of_episodes(root, case):
    line, *words = case
    (root / EPISODES).write_text((root / EPISODES).read_text() + line + "\n")
    refuses(root, *words)


def test_version_3(tmp_path):
    write_version_3(tmp_path, [[6, 5]])
    file = tmp_path / "meta/episodes/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    parquet.write_table(pa.concat_tables([table, table.slice(1)]), file)
    refuses(tmp_path, "file-000.parquet", "lists episode 1 twice")
    for key, value, words in (
        ("data/file_index", None, ["row with gaps"]),
        ("videos/observation.images.top/file_index", 0.5, ["gaps or fractions", "0.5"]),
        ("length", -3, ["length in", "got -3"]),
        ("videos/observation.images.top/from_timestamp", float("nan"), ["from_timestamp of episode 1", "got nan"]),
    ):
        parquet.write_table(table, file)
        edit_table(file, **{key: pa.array([table[key][0].as_py(), value])})
        refuses(tmp_path, *words)
    parquet.write_table(table, file)
    write_info(tmp_path, "v3.0", True, "mkv", video_path="../../{video_key}-{chunk_index}-{file_index}")
    refuses(tmp_path, INFO, "'video_path'", "outside of the data set")


def test_columns_of_another_kind(root):
    """Names that are no list are none; pictures are dictionaries of bytes or a path."""
    info = json.loads((root / INFO).read_text())
    info["features"]["action"]["names"] = 3
    (root / INFO).write_text(json.dumps(info))
    assert open_all(root)[:]["action"].shape == (16, 2)
    edit_table(root / DATA, **{"observation.images.top": pa.array(["x"] * ROWS)})
    refuses(root, "'observation.images.top' of episode 0", "no pictures", "'x'")


def set_stamps(root, stamps):
    edit_table(root / DATA, timestamp=pa.array(np.asarray(stamps, np.float32)))


STAMPS = {
    "all zero": (np.zeros(ROWS), "of frame 1", "timestamp 0 ", "10 others of 12"),
    "backwards": (-np.arange(ROWS) / FPS, "does not increase", "10 others of 12"),
    "nan": (np.full(ROWS, np.nan), "timestamp nan", "11 others of 12"),
}


@pytest.mark.parametrize("case", STAMPS.values(), ids=STAMPS)
def test_stamps_that_are_wrong_throughout(root, case):
    stamps, *words = case
    set_stamps(root, stamps)
    refuses(root, DATA, "episode 0", *words)


@pytest.mark.parametrize("value", [0.3, 0.4, float("nan"), -1.0, 1e6])
def test_one_stamp_that_is_wrong(root, value):
    """Its row is masked, and has a time between its neighbours'."""
    right = open_all(root)[:]
    stamps = np.arange(ROWS) / FPS
    stamps[5] = value
    set_stamps(root, stamps)
    with pytest.warns(
        UserWarning, match=r"1 of 16 rows have a timestamp .*, the first is frame 5 of episode 0; .* False"
    ):
        rows = open_all(root)[:]
    assert rows["observed"][:, 0].tolist() == [k != 5 for k in range(16)]
    torch.testing.assert_close(rows["time"], right["time"], atol=1e-6, rtol=0)
    assert rows["state"].equal(right["state"])


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_states_that_are_not_finite(root, value):
    """Rows hold the last sound numbers (the first row the next), and count neither as seen nor in a loss."""
    right = open_all(root)
    states = joints(0, ROWS)
    bad = [0, 4, 5]
    states[bad, 1] = value
    edit_table(root / DATA, **{"observation.state": pa.array(list(states), pa.list_(pa.float32()))})
    with pytest.warns(UserWarning, match=r"3 of 16 rows have 'state' that is not finite, the first is frame 0 of epi"):
        replay = open_all(root)
    rows, expected = replay[:], right[:]
    good = torch.tensor([k not in bad for k in range(16)])
    for mask in (rows["observed"][:, 0], rows["state_observed"][:, 0], rows["collector", "mask"]):
        assert mask.equal(good)
    source = torch.arange(16)
    source[[0, 4, 5]] = torch.tensor([1, 3, 3])
    assert rows["state"].equal(expected["state"][source])
    assert rows["action"].equal(expected["action"])
    chosen = rows["state"][replay._training_index][good[replay._training_index]].double()
    torch.testing.assert_close(replay.statistics["state", "mean"], chosen.mean(0).float())
    torch.testing.assert_close(replay.statistics["state", "std"], chosen.std(0, correction=0).float())


def test_rows_that_are_not_finite():
    state = torch.rand(6, 2)
    state[4, 0] = torch.nan
    rows = TensorDict(
        {
            "observation": {"image": torch.zeros(6, 3, 8, 8, dtype=torch.uint8), "state": state},
            "episode": torch.tensor([0, 0, 0, 1, 1, 1]),
        },
        [6],
    )
    with pytest.warns(UserWarning, match="the rows: 1 of 6 rows have .state. that is not finite, the first is frame 1"):
        out = recording_from_rows(rows, fps=5.0).rows
    assert out["observed"][:, 0].tolist() == [True, True, True, True, False, True]
    assert out["state"][4].equal(state[3])
