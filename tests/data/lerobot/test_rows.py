"""Rows as torchrl's own robot data sets store them, turned into a recording."""

import cv2
import numpy as np
import pytest
import torch
from tensordict import NonTensorStack, TensorDict
from torchrl.data.datasets import LeRobotExperienceReplay as VLAExperienceReplay
from torchrl.data.datasets import OpenXExperienceReplay
from torchrl.data.datasets.openx import _format_data, _StreamingStorage
from torchrl.data.video import VideoClipRef

import torch_denkf.data.lerobot.rows as rows_module
from torch_denkf.data import LeRobotReplay
from torch_denkf.data.lerobot.rows import recording_from_rows

SIZE = (12, 16)
LENGTHS = [5, 7, 4, 6, 8]
TOTAL = sum(LENGTHS)
ACTIONS = [("action", name) for name in ("world_vector", "rotation_delta", "gripper_closedness_action")]


@pytest.fixture(scope="module")
def stored():
    """Berkeley's UR5 set in small, brought into form by the function with which torchrl stores Open X-Embodiment."""
    rng, episodes = torch.Generator().manual_seed(3), []
    for number, length in enumerate(LENGTHS):
        last = torch.arange(length) == length - 1
        episode = TensorDict(
            {
                "observation": {
                    "image": torch.randint(256, (length, 3, *SIZE), generator=rng, dtype=torch.uint8),
                    "hand_image": torch.randint(256, (length, *SIZE, 3), generator=rng, dtype=torch.uint8),
                    "robot_state": torch.randn(length, 15, generator=rng, dtype=torch.float64),
                },
                "action": {
                    "world_vector": torch.randn(length, 3, generator=rng),
                    "rotation_delta": torch.randn(length, 3, generator=rng),
                    "gripper_closedness_action": torch.randn(length, generator=rng),
                    "terminate_episode": last.float(),
                },
                "is_first": torch.arange(length) == 0,
                "is_last": last,
                "is_terminal": last,
                "reward": last.float(),
                "language_instruction": NonTensorStack.from_list(["sweep"] * length),
            },
            batch_size=[length],
        )
        _format_data(episode, number)
        episodes.append(episode)
    return torch.cat(episodes)


def check(data, stored, images):
    rows = data[:]
    assert [(e.number, e.length) for e in data.episodes] == list(enumerate(LENGTHS))
    torch.testing.assert_close(rows["pixels"], images.float() / 255, rtol=0, atol=0)
    torch.testing.assert_close(rows["state"], stored["observation", "robot_state"].float(), rtol=0, atol=0)
    parts = [stored[key].reshape(TOTAL, -1) for key in ACTIONS]
    torch.testing.assert_close(rows["action"], torch.cat(parts, -1), rtol=0, atol=0)
    frames = torch.cat([torch.arange(length) for length in LENGTHS])
    assert rows["step"].flatten().equal(frames)
    torch.testing.assert_close(rows["time"].flatten(), frames / 5.0, check_dtype=False)
    assert rows["episode"].equal(stored["episode"].long())
    assert rows["observed"].all()
    assert rows["is_init"].flatten().equal(stored["is_init"])
    assert rows["next", "done"].equal(stored["next", "done"])


OPTIONS = {"fps": 5, "state_key": ("observation", "robot_state"), "action_key": ACTIONS}


def test_open_x_as_torchrl_opens_it(stored, tmp_path, monkeypatch):
    """From the memory-mapped folder that torchrl's download leaves, in stretches."""
    monkeypatch.setattr(rows_module, "_CHUNK", 8)
    stored.memmap(tmp_path / "berkeley_autolab_ur5")
    replay = OpenXExperienceReplay("berkeley_autolab_ur5", root=tmp_path, download=False, streaming=False)
    recording = recording_from_rows(replay, names=tuple("abc"), folder=tmp_path / "frames", **OPTIONS)
    data = LeRobotReplay(recording, split="all", slice_len=4, batch_size=12)
    check(data, stored, stored["observation", "image"])
    assert (data.fps, data.names, data.data_path) == (5.0, tuple("abc"), None)
    assert not list((tmp_path / "frames").iterdir())  # the file has no name, so that nothing has to remove it
    batch = data.sample()
    assert batch.shape == (3, 4)
    assert (batch["episode"] == batch["episode"][:, :1]).all()
    assert (batch["step"].diff(dim=1) == 1).all()
    with pytest.raises(RuntimeError, match="recordings in memory were not written"):
        data.delete()


def test_channels_behind_sizes_and_floats(stored):
    hand = ("observation", "hand_image")
    channels_first = stored[hand].permute(0, 3, 1, 2)
    recording = recording_from_rows(stored, pixels_key=hand, **OPTIONS)
    check(LeRobotReplay(recording, split="all"), stored, channels_first)
    recording = recording_from_rows(stored, pixels_key=hand, size=(6, 8), **OPTIONS)
    scaled = [cv2.resize(frame, (8, 6), interpolation=cv2.INTER_AREA) for frame in stored[hand].numpy()]
    check(LeRobotReplay(recording, split="all"), stored, torch.from_numpy(np.stack(scaled)).permute(0, 3, 1, 2))
    rows = stored.clone()
    rows[hand] = stored[hand].float() / 255
    recording = recording_from_rows(rows, pixels_key=hand, **OPTIONS)
    check(LeRobotReplay(recording, split="all"), stored, channels_first)


def test_torchrls_lerobot_rows():
    columns = {
        "observation.state": torch.randn(8, 6),
        "observation.images.top": torch.randint(256, (8, 3, *SIZE), dtype=torch.uint8),
        "action": torch.randn(8, 6),
        "episode_index": torch.tensor([7] * 5 + [4] * 3),
        "task": ["pick"] * 8,
    }
    data = LeRobotReplay(recording_from_rows(VLAExperienceReplay.from_columns(columns), fps=30), split="all")
    rows = data[:]
    assert rows["pixels"].equal(columns["observation.images.top"].float() / 255)
    assert rows["state"].equal(columns["observation.state"])
    assert rows["action"].equal(columns["action"])
    assert [(e.number, e.start, e.length) for e in data.episodes] == [(7, 0, 5), (4, 5, 3)]


def test_errors(stored, monkeypatch):
    def fails(error, match, rows=stored, **options):
        with pytest.raises(error, match=match):
            recording_from_rows(rows, **{**OPTIONS, **options})

    fails(
        KeyError,
        r"the rows lack observation/state; they have action/gr.*, observation/hand_image",
        state_key=("observation", "state"),
    )
    fails(ValueError, r"action must be numbers \[N, n\], it has several entries: pass a list", action_key="action")
    fails(ValueError, r"must be numbers \[N, n\], it has shape", state_key=("observation", "image"))
    fails(ValueError, r"must be \[N, 3, H, W\] .* got torch.float64 \(30, 15\)",
          pixels_key=("observation", "robot_state"))  # fmt: skip
    fails(KeyError, r"has the cameras .*; pass pixels_key= of one of them", pixels_key="observation")
    fails(TypeError, r"holds NonTensorStack, not images", pixels_key="language_instruction")
    video = TensorDict({"image": VideoClipRef.from_files(["x.mp4"], num_frames_per_file=[TOTAL])}, batch_size=[TOTAL])
    rows = stored.clone(False).update({"video": video})
    fails(TypeError, r"holds VideoClipRef, not images; decode", rows=rows, pixels_key=("video", "image"))
    fails(ValueError, r"there are no rows", rows=stored[:0])
    monkeypatch.setattr(_StreamingStorage, "_init", lambda self: None)  # no connection
    streaming = OpenXExperienceReplay("berkeley_autolab_ur5", streaming=True, slice_len=4)
    fails(TypeError, r"streamed data has no rows to index; open it with download=True", rows=streaming)
