"""The replay shows exactly the drive's rows, whatever TorchRL wraps around it."""

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.applications.car import KITTIReplayEnv, dead_reckoning, read_kitti_drive, write_drives
from torch_denkf.applications.car.kitti.frames import drive_frames
from torch_denkf.applications.car.vision.poses import poses_to_state, state_to_poses

ROWS = 24
KEYS = ("pixels", "state", "observed", "time")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kitti")
    write_drives(folder, ["town"], frames=ROWS, size=(12, 36))
    (folder / "sequences/town/image_2/000009.png").unlink()  # a gap
    return folder


@pytest.fixture(scope="module")
def drive(root):
    return read_kitti_drive(root, "town", size=(12, 36), cache=None)


def same(rollout, frames, rows, keys=KEYS):
    for key in keys:
        torch.testing.assert_close(rollout[key], frames[key][rows], rtol=0, atol=0)


@pytest.mark.parametrize("colour", [True, False, None])
def test_a_rollout_is_the_drives_frames(root, tmp_path, colour):
    env = KITTIReplayEnv(root, "town", size=(10, 30), colour=colour, cache=tmp_path)
    frames = drive_frames(read_kitti_drive(root, "town", size=(10, 30), colour=colour, cache=tmp_path))
    rollout = env.rollout(1000)
    assert rollout.batch_size == (ROWS - 1,)
    assert rollout["pixels"].shape[1:] == (6 if colour is not False else 2, 10, 30)
    same(rollout, frames, slice(0, ROWS - 1))
    same(rollout["next"], frames, slice(1, ROWS))
    assert (rollout["is_init"] == frames["is_init"][:-1]).all()
    assert not rollout["next", "is_init"].any()
    flags = rollout["next"].select("done", "truncated", "terminated")
    assert flags["truncated"].flatten().tolist() == [False] * (ROWS - 2) + [True]
    assert (flags["truncated"] == flags["done"]).all()
    assert not flags["terminated"].any()
    assert not rollout["next", "reward"].any()
    # The gap blinds two frames.
    assert (~rollout["observed"]).flatten().nonzero().flatten().tolist() == [0, 9, 10]
    assert env.dt == pytest.approx(0.103)


def test_the_pair_that_shows_a_speed_is_labelled_with_it():
    """5 m/s, then 12 m/s from the step into frame 7 on; a mark's column shows where the car is."""
    rows, dt = 12, 0.1
    speed = torch.tensor([5.0] * 7 + [12.0] * 5, dtype=torch.float64)
    velocities = torch.stack([speed, torch.zeros(rows)], -1)
    path = dead_reckoning(velocities, torch.zeros(3, dtype=torch.float64), dt).numpy()
    state = torch.from_numpy(poses_to_state(state_to_poses(path), dt)).float()
    place = (state[:, 0] * 10).round().long()  # a tenth of a metre for each pixel
    image = torch.zeros(rows, 1, 1, 100, dtype=torch.uint8)
    image[torch.arange(rows), 0, 0, place] = 255
    drive = TensorDict(
        {
            "image": image,
            "frame_valid": torch.ones(rows, 1, dtype=torch.bool),
            "state": state,
            "time": dt * torch.arange(rows, dtype=torch.float64).unsqueeze(-1),
            "dt": torch.full((rows, 1), dt),
        },
        [rows],
    )
    rollout = KITTIReplayEnv(drive).rollout(100)["next"]
    difference = rollout["pixels"][:, 1, 0]
    moved = (difference.argmax(-1) - difference.argmin(-1)) / 10  # in the images, in m
    assert rollout["observed"].all()
    torch.testing.assert_close(moved / dt, rollout["state"][:, 3])
    assert rollout["state"][:, 3].tolist() == pytest.approx([5.0] * 6 + [12.0] * 5)
