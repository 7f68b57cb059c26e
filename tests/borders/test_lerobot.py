"""Damaged recordings in LeRobot's layout: an error names file and entry, or damaged rows are masked and counted."""

import json
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import torch

from tests.borders.test_constructors import message_of
from tests.data.lerobot.lerobot_folder import FPS, SIZE, joints, write_version_2, write_version_3
from tests.data.lerobot.test_errors import edit_table
from torch_denkf.data import LeRobotReplay

open_all = partial(LeRobotReplay, size=SIZE, cache=None, split="all")
INFO, EPISODES = "meta/info.json", "meta/episodes.jsonl"
DATA = "data/chunk-000/episode_000000.parquet"
ROWS = 12


@pytest.fixture
def root(tmp_path):
    """Returns two episodes, of 12 rows and of 4."""
    write_version_2(tmp_path, [ROWS, 4], images="bytes")
    return tmp_path


@pytest.mark.parametrize("key", ["fps", "chunks_size"])
def test_nothing_a_second_or_a_chunk(root, key):
    info = json.loads((root / INFO).read_text())
    (root / INFO).write_text(json.dumps({**info, key: 0}))
    message_of(lambda: open_all(root), f"{key} in", INFO, "got 0")


def test_an_episode_that_is_listed_twice(tmp_path, root):
    (root / EPISODES).write_text((root / EPISODES).read_text() + '{"episode_index": 0, "length": 12}\n')
    message_of(lambda: open_all(root), EPISODES, "lists episode 0 twice")
    write_version_3(tmp_path / "newer", [[6, 5]])
    file = tmp_path / "newer/meta/episodes/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    parquet.write_table(pa.concat_tables([table, table.slice(1)]), file)
    message_of(lambda: open_all(tmp_path / "newer"), "file-000.parquet", "lists episode 1 twice")


def set_stamps(root, stamps):
    edit_table(root / DATA, timestamp=pa.array(np.asarray(stamps, np.float32)))


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
    """Damaged rows repeat the last valid values (the first row the next ones), and are masked."""
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
