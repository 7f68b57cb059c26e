"""The reader, on a layout written by hand with known numbers, and on a few real frames where they are."""

import math

import cv2
import numpy as np
import pytest
import torch

from tests.real_data import KITTI
from torch_denkf.applications.car import dead_reckoning, read_kitti_drive
from torch_denkf.applications.car.kitti.files import read_poses
from torch_denkf.applications.car.vision.poses import poses_to_state, state_to_poses

cv2.setNumThreads(1)


def make(root, *, images=range(6), poses=None, camera="image_2", sequence="00", grey=False, size=(10, 30), times=True):
    """Returns a drive whose frame k is flat in colour (B, G, R) = (k, 50 + k, 100 + k) and which moves 1 m a frame."""
    folder = root / "sequences" / sequence
    (folder / camera).mkdir(parents=True, exist_ok=True)
    (root / "poses").mkdir(exist_ok=True)
    for k in images:
        picture = np.full((*size, 3), (k, 50 + k, 100 + k), np.uint8)
        cv2.imwrite(str(folder / camera / f"{k:06d}.png"), picture[..., 1] if grey else picture)
    rows = range(6) if poses is None else poses
    text = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in rows)
    (root / "poses" / f"{sequence}.txt").write_text(text)
    calibration = "20 0 14.5 0 0 18 4.5 0 0 0 1 0"
    (folder / "calib.txt").write_text("".join(f"P{k}: {k + 1}{calibration[1:]}\n" for k in range(4)))
    if times:
        (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(len(rows))))
    return root


def test_a_drive_by_hand(tmp_path):
    drive = read_kitti_drive(make(tmp_path), "00", size=(10, 30), cache=None)
    assert drive.batch_size == (6,)
    assert drive["image"].dtype == torch.uint8
    assert drive["image"].shape == (6, 3, 10, 30)
    assert drive["image"][4, :, 3, 3].tolist() == [104, 54, 4]  # RGB
    assert drive["frame_valid"].all()
    expected = [[k, 0, 0, 10, 0] for k in range(6)]
    torch.testing.assert_close(drive["state"], torch.tensor(expected, dtype=torch.float32))
    torch.testing.assert_close(drive["time"], 0.1 * torch.arange(6, dtype=torch.float64).unsqueeze(-1))
    assert drive["frame"].flatten().tolist() == list(range(6))
    torch.testing.assert_close(drive["dt"], torch.full((6, 1), 0.1))
    # P2 begins with 30: fx 30, fy 18; the size is that of the files.
    torch.testing.assert_close(drive["calibration"], torch.tensor([30.0, 18.0, 14.5, 4.5]).expand(6, 4))
    scaled = read_kitti_drive(tmp_path, 0, size=(5, 60), cache=None)
    # Pixel centres are at whole numbers: the middle of 30 columns, 14.5, becomes that of 60, 29.5.
    torch.testing.assert_close(scaled["calibration"][0], torch.tensor([60.0, 9.0, 29.5, 2.0]))
    assert scaled["image"].shape == (6, 3, 5, 60)
    assert scaled["image"][4, :, 3, 3].tolist() == [104, 54, 4]


def test_the_pose_matrix_is_kittis():
    """By hand: after a quarter turn to the right, the camera looks along world x, and x is -y of the state."""
    right = np.array([[0, 0, 1, 5.0], [0, 1, 0, 0.3], [-1, 0, 0, 7.0]])
    state = poses_to_state(right[None], 0.1)
    np.testing.assert_allclose(state, [[7, -5, -math.pi / 2, 0, 0]], atol=1e-12)
    # Columns of R are the camera's axes in the world: right, down, forward.
    rotation = state_to_poses(np.array([[0.0, 0.0, 0.4]]))[0, :, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation[:, 2], [-math.sin(0.4), 0, math.cos(0.4)])  # forward, and left of it


def test_dead_reckoning_integrates_the_differences():
    rng = np.random.default_rng(0)
    velocities = torch.tensor(np.stack([rng.uniform(-3, 15, 200), rng.uniform(-0.3, 0.7, 200)], -1))
    path = dead_reckoning(velocities, torch.tensor([3.0, -2.0, 1.0]).double(), 0.103)
    state = torch.from_numpy(poses_to_state(state_to_poses(path.numpy()), 0.103))
    assert state[:, 2].max() > 3.5  # more than half a turn: angles are not wrapped
    torch.testing.assert_close(state[1:, 3:], velocities[1:])
    torch.testing.assert_close(state[0, 3:], velocities[1])  # the first row takes that of the next


def test_missing_frames_keep_their_row(tmp_path):
    drive = read_kitti_drive(make(tmp_path, images=[1, 2, 4]), "00", size=(10, 30), cache=None)
    assert drive["frame"].flatten().tolist() == [1, 2, 3, 4]  # frames 0 and 5 lie outside of the first and last image
    assert drive["frame_valid"].flatten().tolist() == [True, True, False, True]
    assert (drive["image"][2] == 0).all()
    assert drive["state"][:, 0].tolist() == [1, 2, 3, 4]
    torch.testing.assert_close(drive["state"][:, 3], torch.full((4,), 10.0))  # the first from the pose before
    assert drive["time"].flatten().tolist() == pytest.approx([0.1, 0.2, 0.3, 0.4])


# Real frames ---------------------------------------------------------------------------------------------------------


# The mean step is that of all rows; for 09 the reference code's own statistics say 1.0712 m (full_parameters.pkl).
@pytest.mark.parametrize(("sequence", "mean_step"), [("00", 0.820), ("09", 1.0712)])
def test_real_poses_have_the_state_of_kloss(sequence, mean_step):
    file = KITTI / "poses" / f"{sequence}.txt"
    if not file.is_file():
        pytest.skip(f"no KITTI poses at {file}")
    poses = read_poses(file)
    state = poses_to_state(poses, 0.103)
    np.testing.assert_array_equal(state[:, 0], poses[:, 2, 3])
    np.testing.assert_array_equal(state[:, 1], -poses[:, 0, 3])
    theta = -np.arctan2(-poses[:, 2, 0], poses[:, 2, 2])
    np.testing.assert_allclose(np.exp(1j * state[:, 2]), np.exp(1j * theta))
    assert np.abs(np.diff(state[:, 2])).max() < 0.2
    assert state[:, 3].min() > -0.2  # KITTI's car does not reverse
    assert 0.103 * state[:, 3].mean() == pytest.approx(mean_step, abs=0.003)
    # Left is positive: over a second, the path's direction turns as the heading does.
    ten = state[10:, :2] - state[:-10, :2]
    bend = np.arctan2(ten[:-10, 0] * ten[10:, 1] - ten[:-10, 1] * ten[10:, 0], (ten[:-10] * ten[10:]).sum(-1))
    fast = np.linalg.norm(ten[:-10], axis=-1) > 3
    assert np.corrcoef(bend[fast], (state[15:-5, 2] - state[5:-15, 2])[fast])[0, 1] > 0.95
