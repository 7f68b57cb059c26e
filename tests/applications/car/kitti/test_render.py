"""Rendered drives: what is read back is what was generated, and images move as the recorded motion says."""

import dataclasses
import zlib

import cv2
import numpy as np
import pytest
import torch

from torch_denkf.applications.car import read_kitti_drive, write_drives
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.render import random_drive, roadside_scene
from torch_denkf.applications.car.street.camera import Camera
from torch_denkf.applications.car.street.renderer import Renderer
from torch_denkf.applications.car.street.scene import Box
from torch_denkf.applications.car.vision.poses import KITTI_DT, state_to_poses

cv2.setNumThreads(1)


def ground_homography(camera: Camera, pose: np.ndarray, origin=(0.0, 0.0), scale: float = 1.0) -> np.ndarray:
    """Homography from ground coordinates to pixels.

    Args:
        camera: the camera.
        pose: camera-to-world matrix, ``[3, 4]``.
        origin: (x, z) of ground coordinate (0, 0), in m.
        scale: m for each unit of the ground coordinates.

    Returns:
        ``[3, 3]``, from (x, z, 1) to homogeneous pixels, whose third entry is the depth in m.
    """
    rotation, position = pose[:, :3], pose[:, 3]
    plane = np.array([[scale, 0, origin[0]], [0, 0, camera.height], [0, scale, origin[1]]])
    plane[:, 2] -= position
    return camera.matrix @ rotation.T @ plane


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


def test_the_homography_is_the_pinhole_projection():
    camera, rng = Camera.kitti((50, 150)), np.random.default_rng(0)
    for _ in range(20):
        state = np.array([[*rng.uniform(-50, 50, 2), rng.uniform(-3, 3)]])
        pose = state_to_poses(state)[0]
        points = np.stack([*rng.uniform(-80, 80, (2, 30))])  # x, z of ground points
        world = np.stack([points[0], np.full(30, camera.height), points[1]])
        seen = pose[:, :3].T @ (world - pose[:, 3:])
        flat = ground_homography(camera, pose, (3.0, -4.0), 0.5) @ np.stack(
            [(points[0] - 3) / 0.5, (points[1] + 4) / 0.5, np.ones(30)]
        )
        np.testing.assert_allclose(flat[2], seen[2])
        np.testing.assert_allclose(flat[0] / flat[2], camera.fx * seen[0] / seen[2] + camera.cx)
        np.testing.assert_allclose(flat[1] / flat[2], camera.fy * seen[1] / seen[2] + camera.cy)
        # In the state's terms: a point d ahead and a aside to the left of the car appears left of the centre.
        x, y, theta = state[0]
        ahead, left = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        px, py = np.array([x, y]) + 10 * ahead + 2 * left
        spot = ground_homography(camera, pose) @ [-py, px, 1]
        np.testing.assert_allclose(spot[:2] / spot[2], [camera.cx - camera.fx / 5, camera.cy + camera.fy * 0.165])


def test_a_box_appears_where_its_corners_project():
    rng = np.random.default_rng(0)
    scene = roadside_scene(random_drive(120, rng), rng)
    corners = np.array([[2.0, 14.0], [4.0, 14.0], [4.0, 18.0], [2.0, 18.0]])  # x to the right, z ahead
    red = [np.full((32, 32, 3), (0, 0, 255), np.uint8)]
    scene = dataclasses.replace(scene, light=np.ones(3), objects=[Box(corners, 1.2, [red] * 4)])
    camera = Camera.kitti((100, 300))
    for x, theta in ((0.0, 0.0), (4.0, 0.1), (8.0, -0.1)):
        pose = state_to_poses(np.array([[x, 0.0, theta]]))[0]
        picture = Renderer(scene, camera).render(pose).astype(int)
        seen = (picture[..., 2] - picture[..., 1] > 90).nonzero()
        points = [[cx, y, cz] for cx, cz in corners for y in (camera.height, camera.height - 1.2)]
        local = (np.array(points) - pose[:, 3]) @ pose[:, :3]
        u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
        v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
        for found, expected in ((seen[1], u), (seen[0], v)):
            assert abs(found.min() - expected.min()) < 1.01
            assert abs(found.max() - expected.max()) < 1.01
