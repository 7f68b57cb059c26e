"""Recordings that lack something, are damaged, or contradict themselves: errors and warnings name the place."""

import json
import shutil
from functools import partial
from unittest.mock import patch

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import torch

from tests.data.lerobot.lerobot_folder import SIZE, joints, png, write_info, write_version_2, write_version_3
from torch_denkf.data import LeRobotReplay
from torch_denkf.data import parquet as parquet_reader
from torch_denkf.data.pictures import decode_picture

open_all = partial(LeRobotReplay, size=SIZE, cache=None, split="all")
CAMERA = "observation.images.top"


def fails(error, match, root, **options):
    with pytest.raises(error, match=match):
        open_all(root, **options)


def edit_table(file, **columns):
    table = parquet.read_table(file)
    for name, values in columns.items():
        table = table.drop_columns([name]) if name in table.column_names else table
        table = table if values is None else table.append_column(name, values)
    parquet.write_table(table, file)


def test_cameras_and_features(tmp_path):
    write_version_2(tmp_path, [4])
    write_info(tmp_path, "v2.1", True, cameras=(CAMERA, "observation.images.wrist"))
    fails(ValueError, r"has several cameras; pass camera=, one of \['observation.images.top', 'obs", tmp_path)
    info = json.loads((tmp_path / "meta/info.json").read_text())
    info["features"]["observation.images.wrist"]["info"] = {"video.is_depth_map": True}
    write_info(tmp_path, "v2.1", True, "mkv", features=info["features"])
    assert len(open_all(tmp_path)) == 4  # a depth map is no camera
    write_info(tmp_path, "v2.1", True, cameras=())
    fails(ValueError, r"info.json names no camera: no feature of dtype video or image", tmp_path)


def test_a_damaged_frame_blinds_its_row_alone(tmp_path):
    """The decoder leaves frame 4 out; those after it keep their rows."""
    write_version_2(tmp_path, [9], codec="MJPG", suffix="avi")
    video = tmp_path / f"videos/chunk-000/{CAMERA}/episode_000000.avi"
    before = open_all(tmp_path)[:]["pixels"]
    data = bytearray(video.read_bytes())
    starts = [k for k in range(len(data)) if data[k : k + 3] == b"\xff\xd8\xff"]
    assert len(starts) == 9
    data[starts[4] : starts[5] - 24] = bytes(starts[5] - 24 - starts[4])
    video.write_bytes(data)
    with pytest.warns(UserWarning, match=r"episode_000000.avi: of episode 0 these frames .* \(observed False\): 4$"):
        replay = open_all(tmp_path)
    rows = replay[:]
    assert rows["observed"].flatten().tolist() == [k != 4 for k in range(9)]
    others = [k for k in range(9) if k != 4]
    assert rows["pixels"][others].equal(before[others])
    assert not rows["pixels"][4].any()
    assert (rows["state"].numpy() == joints(0, 9)).all()
    expected = before[others].double().mean((0, 2, 3)).float()
    torch.testing.assert_close(replay.statistics["pixels", "mean"].flatten(), expected)  # without the missing one


@pytest.mark.parametrize("key", ["data_path", "video_path"])
@pytest.mark.parametrize("version", [2, 3])
def test_paths_that_lead_out_of_the_data_set_raise(tmp_path, version, key):
    root, elsewhere = tmp_path / "robot", tmp_path / "elsewhere"
    write_version_2(root, [4, 4]) if version == 2 else write_version_3(root, [[4, 4]])
    open_all(root)
    shutil.copytree(root, elsewhere)
    file = root / "meta/info.json"
    info = json.loads(file.read_text())
    for prefix in ("../elsewhere/", f"{elsewhere}/", "data/../../elsewhere/"):
        file.write_text(json.dumps({**info, key: prefix + info[key]}))
        fails(ValueError, rf"info.json.* names a file outside of the data set, '{prefix}.*download it from where", root)
    for template in ("{x}", "{0}", "{episode_index:99999999d}", "{episode_index.real}", "{", 7):
        file.write_text(json.dumps({**info, key: template}))
        fails(
            ValueError,
            r"info.json (has a path .* that cannot be filled in|is malformed: '.*_path' is no template)",
            root,
        )
    file.write_text(json.dumps({**info, key: f"{root}/{info[key]}"}))  # absolute, but inside
    assert len(open_all(root)) == 8


def test_decompression_bombs_raise_before_unpacking(tmp_path):
    write_version_2(tmp_path, [4, 4], images="bytes")
    file = tmp_path / "data/chunk-000/episode_000000.parquet"
    with patch.object(parquet_reader, "MOST_BYTES", 1000), patch.object(parquet_reader, "MOST_RATIO", 0.01):
        fails(ValueError, r"episode_000000.parquet has \d+ bytes and announces 4 rows of together \d+ bytes", tmp_path)
    picture = bytearray(png(np.zeros((*SIZE, 3), np.uint8)))
    picture[16:24] = (30000).to_bytes(4) + (30000).to_bytes(4)
    edit_table(file, **{CAMERA: pa.array([{"bytes": bytes(picture), "path": None}] * 4)})
    fails(ValueError, r"shows none of the 4 frames of episode 0", tmp_path)
    _, jpeg = cv2.imencode(".jpg", np.zeros((*SIZE, 3), np.uint8))
    assert decode_picture(jpeg.tobytes()).shape == (*SIZE, 3)
    data = bytearray(jpeg.tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = (30000).to_bytes(2) * 2
    assert decode_picture(bytes(data)) is None


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_states_that_are_not_finite(tmp_path, value):
    """Damaged rows repeat the last valid values (the first row the next ones), and are masked."""
    write_version_2(tmp_path, [12, 4], images="bytes")
    right = open_all(tmp_path)
    states = joints(0, 12)
    bad = [0, 4, 5]
    states[bad, 1] = value
    edit_table(
        tmp_path / "data/chunk-000/episode_000000.parquet",
        **{"observation.state": pa.array(list(states), pa.list_(pa.float32()))},
    )
    with pytest.warns(UserWarning, match=r"3 of 16 rows have 'state' that is not finite, the first is frame 0 of epi"):
        replay = open_all(tmp_path)
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
