"""Rendered drives: what is read back is what was generated, and images move as the recorded motion says."""

import zlib

import cv2
import numpy as np
import pytest
import torch

from torch_denkf.applications.car import read_kitti_drive, write_drives
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.render import random_drive
from torch_denkf.applications.car.street.camera import Camera
from torch_denkf.applications.car.vision.poses import KITTI_DT

cv2.setNumThreads(1)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    root = tmp_path_factory.mktemp("drives")
    write_drives(root, ["town", "hill"], frames=60, seed=3)
    return root


def test_reading_back_gives_the_generated_state(town):
    rng = np.random.default_rng([3, zlib.crc32(b"town")])
    expected = torch.from_numpy(random_drive(60, rng))
    drive = read_kitti_drive(town, "town", cache=None)
    torch.testing.assert_close(drive["state"].double(), expected, atol=1e-4, rtol=0)
    assert drive["image"].shape == (60, 3, 50, 150)
    assert drive["frame_valid"].all()
    torch.testing.assert_close(drive["dt"], torch.full((60, 1), 0.103))
    torch.testing.assert_close(drive["time"].squeeze(-1), 0.103 * torch.arange(60.0, dtype=torch.float64))
    camera = Camera.kitti((50, 150))
    expected = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy])
    torch.testing.assert_close(drive["calibration"][7], expected)
    assert list_kitti_drives(town) == ["hill", "town"]


def test_the_camera_is_kittis():
    # calib.txt of KITTI's colour drives at 1242 x 375: 721.5377, 609.5593, 172.854.
    camera = Camera.kitti((375, 1242))
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [721.54, 721.54, 609.56, 172.85], atol=0.1)


def test_drives_move_like_a_car():
    for seed in range(40):
        state = random_drive(300, np.random.default_rng(seed))
        speed, turn = state[:, 3], state[:, 4]
        assert speed.min() >= 0
        assert speed.max() <= 15
        assert np.abs(np.diff(speed) / KITTI_DT).max() <= 2 + 1e-9
        assert np.abs(turn).max() <= 0.5
        assert np.abs(speed * turn).max() < 4.0  # m/s² to the side
        assert np.abs(np.diff(turn)).max() < 0.1  # smooth: rad/s from frame to frame
    many = np.concatenate([random_drive(300, np.random.default_rng(seed)) for seed in range(40)])
    assert 6 < many[:, 3].mean() < 10
    assert 0 < (many[:, 3] < 0.5).mean() < 0.1  # stops, but few
    assert (np.abs(many[:, 4]) < 0.1).mean() > 0.6  # mostly straight on
    assert (np.abs(many[:, 4]) > 0.25).mean() > 0.02  # but real turns as well
    assert abs(np.sign(many[:, 4]).mean()) < 0.2  # to both sides
