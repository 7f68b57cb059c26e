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

from tests.data.lerobot.lerobot_folder import (
    SIZE,
    joints,
    pictures,
    png,
    write_info,
    write_version_2,
    write_version_3,
    write_video,
)
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


def test_folders_that_lack_something(tmp_path):
    info, episodes = tmp_path / "meta/info.json", tmp_path / "meta/episodes.jsonl"
    fails(FileNotFoundError, r"no .*meta/info.json; pass the folder of a LeRobot data set", tmp_path)
    info.parent.mkdir()
    for text, match in (
        ('{"fps": 10', r"meta/info.json is malformed"),
        ('{"fps": 10, "codebase_version": "v2.1"}', r"meta/info.json is malformed \(KeyError: 'features'\)"),
    ):
        info.write_text(text)
        fails(ValueError, match, tmp_path)
    write_info(tmp_path, "v2.1", True)
    fails(FileNotFoundError, r"no .*meta/episodes.jsonl, which lists the episodes", tmp_path)
    for text, error, match in (
        ("\n", ValueError, r"has no episodes: .*episodes.jsonl lists none; download"),
        ('{"episode_index": 0}\n', ValueError, r"episodes.jsonl has a malformed line '\{\"episode_index\": 0\}'"),
        (
            '{"episode_index": 3, "length": 4}\n',
            FileNotFoundError,
            r"no .*data/chunk-001/episode_000003.parquet, which the data set's metadata",
        ),
    ):
        episodes.write_text(text)
        fails(error, match, tmp_path)
    write_info(tmp_path, "v3.0", True)
    fails(FileNotFoundError, r"no .*meta/episodes/\*/\*.parquet", tmp_path)
    for version in ("v1.6", "v4.0"):
        write_info(tmp_path, version, True)
        fails(ValueError, rf"LeRobot's version '{version}'; this reader knows v2.0, v2.1, v3.0", tmp_path)


def test_cameras_and_features(tmp_path):
    write_version_2(tmp_path, [4])
    fails(ValueError, r"has no camera 'wrist'; it has \['observation.images.top'\]", tmp_path, camera="wrist")
    fails(ValueError, r"has no feature 'observation.effort'; it has \[", tmp_path, state_key="observation.effort")
    fails(ValueError, r"has no feature 'torque'", tmp_path, action_key="torque")
    fails(
        ValueError,
        r"feature 'observation.images.top' of .* is no vector: video \[48, 64, 3\]",
        tmp_path,
        state_key=CAMERA,
    )
    fails(ValueError, r"size is \(height, width\)", tmp_path, size=(0, 3))
    fails(ValueError, r"split is 'train', 'validation', 'test' or 'all', got 'val'", tmp_path, split="val")
    write_info(tmp_path, "v2.1", True, cameras=(CAMERA, "observation.images.wrist"))
    fails(ValueError, r"has several cameras; pass camera=, one of \['observation.images.top', 'obs", tmp_path)
    info = json.loads((tmp_path / "meta/info.json").read_text())
    info["features"]["observation.images.wrist"]["info"] = {"video.is_depth_map": True}
    write_info(tmp_path, "v2.1", True, "mkv", features=info["features"])
    assert len(open_all(tmp_path)) == 4  # a depth map is no camera
    write_info(tmp_path, "v2.1", True, cameras=())
    fails(ValueError, r"info.json names no camera: no feature of dtype video or image", tmp_path)


def test_missing_and_unreadable_videos(tmp_path):
    write_version_2(tmp_path, [4, 5], codec="mp4v", suffix="mp4")
    video = tmp_path / f"videos/chunk-000/{CAMERA}/episode_000001.mp4"
    whole = video.read_bytes()
    video.write_bytes(whole[: len(whole) // 2])
    fails(ValueError, r"no frame of .*episode_000001.mp4 can be decoded", tmp_path)
    video.unlink()
    fails(
        FileNotFoundError, r"no .*episode_000001.mp4, which .* pass another camera, or pass episodes=.*: 0$", tmp_path
    )
    write_video(video, pictures(1, 5, (24, 32)), "mp4v")
    fails(
        ValueError,
        r"episode_000001.mp4 is 32 pixels wide and 24 high, but .*episode_000000.mp4 is 64 pixels wide",
        tmp_path,
    )


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


def test_images_that_cannot_be_decoded(tmp_path):
    write_version_2(tmp_path, [6], images="bytes")
    file = tmp_path / "data/chunk-000/episode_000000.parquet"
    images = [{"bytes": png(frame), "path": None} for frame in pictures(0, 6)]
    images[1]["bytes"] = images[1]["bytes"][:-30]
    images[3] = None
    images[4]["bytes"] = b"nothing"
    images[5] = {"bytes": None, "path": "images/not_there.png"}
    kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
    edit_table(file, **{CAMERA: pa.array(images, kind)})
    with pytest.warns(UserWarning, match=r"episode_000000.parquet: of episode 0 these frames .*: 1, 3, 4, 5$"):
        rows = open_all(tmp_path)[:]
    assert rows["observed"].flatten().tolist() == [True, False, True, False, False, False]
    assert not rows["pixels"][[1, 3, 4, 5]].any()
    images[1] = {"bytes": png(pictures(0, 1, (24, 32))[0]), "path": None}
    edit_table(file, **{CAMERA: pa.array(images, kind)})
    fails(ValueError, r"frame 1 of .*000000.parquet is 32 pixels wide and 24 high, but frame 0 of .* is 64", tmp_path)
    edit_table(file, **{CAMERA: pa.array([None] * 6, kind)})
    fails(ValueError, r"episode_000000.parquet shows none of the 6 frames of episode 0", tmp_path)


def test_tables_that_are_damaged_or_contradict_the_metadata(tmp_path):
    write_version_2(tmp_path, [6], images="bytes")
    file = tmp_path / "data/chunk-000/episode_000000.parquet"
    whole = file.read_bytes()
    wide = pa.array(list(np.ones((6, 4), np.float32)), pa.list_(pa.float32()))
    ragged = pa.array([[1.0, 2, 3]] * 5 + [[1.0]], pa.list_(pa.float32()))
    holes = pa.array([[1.0, 2, 3]] * 5 + [[1.0, None, 3]], pa.list_(pa.float32()))
    gap = pa.array([[1.0, 2, 3]] * 5 + [None], pa.list_(pa.float32()))
    says = r"'observation.state' in .*episode_000000.parquet has {}; meta/info.json says 3 in each row"
    for column, match in (
        (wide, says.format(r"rows of \[4\] numbers")),
        (ragged, says.format(r"rows of \[1, 3\] numbers")),
        (holes, says.format("gaps")),
        (gap, says.format("gaps")),
        (None, r"episode_000000.parquet lacks the columns \['observation.state'\]; it has \['action'"),
    ):
        edit_table(file, **{"observation.state": column})
        fails(ValueError, match, tmp_path)
        file.write_bytes(whole)
    edit_table(file, frame_index=pa.array([0, 1, 3, 2, 4, 5]))
    fails(ValueError, r"frame_index of episode 0 does not count from 0 by ones", tmp_path)
    file.write_bytes(whole[: len(whole) // 2])
    fails(ValueError, r"episode_000000.parquet is no complete parquet file", tmp_path)
    file.write_bytes(whole)
    (tmp_path / "meta/episodes.jsonl").write_text('{"episode_index": 0, "length": 7}')
    fails(ValueError, r"000000.parquet has 6 rows of episode 0, but the metadata says 7", tmp_path)


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
    episodes = tmp_path / "meta/episodes.jsonl"
    text = episodes.read_text()
    episodes.write_text('{"episode_index": 0, "length": 1000000000000}\n')
    fails(ValueError, r"announces 1000000000000 rows, more than the 100000000 that are read", tmp_path)
    episodes.write_text(text)
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
