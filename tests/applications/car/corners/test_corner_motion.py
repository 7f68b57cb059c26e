"""The motion that stereo corners show: of drawn points, and of a real drive."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.real_data import KITTI, SHARED
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.drive import corner_replay, read_corner_drive
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motion, corner_motions, started_by_ransac
from torch_denkf.applications.car.kitti.files import read_poses
from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error
from torch_denkf.envs import ReplayEnv
from torch_denkf.functional.manifolds import SE3, SO3, quaternion_of, rotate

CAMERA = StereoCamera(700.0, (600.0, 180.0), 0.54)
DRIVE = SHARED / "kitti_inertial" / "0027.npz"


@pytest.fixture(autouse=True)
def _double(float64):
    return


def drawn(batch=20, count=60, noise=None, seed=0):
    """Returns points ahead, a motion of a metre, and the corners of both rows."""
    torch.manual_seed(seed)
    points = torch.randn(batch, count, 3) * torch.tensor([8.0, 2.0, 10.0]) + torch.tensor([0.0, 0.0, 25.0])
    points[..., 2] = points[..., 2].clamp_min(5.0)
    motion = SE3().exp(torch.cat([0.02 * torch.randn(batch, 3), torch.tensor([0.0, 0.0, 1.0]).expand(batch, 3)], -1))
    moved = rotate(SO3().inverse(motion[:, None, :4]), points - motion[:, None, 4:])
    corners = [CAMERA.project(points), CAMERA.project(moved)]
    if noise is not None:
        stds = torch.tensor([[0.0, 0.0, noise.disparity], [noise.pixel, noise.pixel, noise.disparity]])
        corners = [corner + std * torch.randn_like(corner) for corner, std in zip(corners, stds, strict=True)]
    return *corners, torch.ones(batch, count, dtype=torch.bool), motion


def test_camera_projects_reconstructed_points():
    before, *_ = drawn()
    torch.testing.assert_close(CAMERA.project(CAMERA.points(before)), before)
    points = CAMERA.points(before)
    numeric = torch.func.vmap(torch.func.jacrev(CAMERA.project))(points.flatten(0, 1))
    torch.testing.assert_close(CAMERA.jacobian(points).flatten(0, 1), numeric)
    numeric = torch.func.vmap(torch.func.jacrev(CAMERA.points))(before.flatten(0, 1))
    torch.testing.assert_close(CAMERA.jacobian_of_points(before).flatten(0, 1), numeric)


def test_corners_without_noise_give_the_motion():
    before, after, seen, motion = drawn()
    found = corner_motion(before, after, seen, CAMERA)
    assert SE3().distance(found.motion, motion).max() < 1e-8


def test_the_covariance_is_that_of_the_errors():
    """Corners with the noise that is claimed, almost Gaussian: 400 motions, a standard error of 7 %."""
    noise = CornerNoise(0.3, 0.0, 0.3, 0.0, 0.0, 0.0, freedom=200.0)
    before, after, seen, motion = drawn(400, noise=noise)
    found = corner_motion(before, after, seen, CAMERA, noise)
    error = SE3().minus(found.motion, motion)
    share = (error.square() / found.cov.diagonal(dim1=-2, dim2=-1)).mean(0)
    assert ((share > 0.7) & (share < 1.3)).all()


def test_wrong_corners_are_left_out():
    before, after, seen, motion = drawn()
    after[:, ::5] += 20 * torch.randn_like(after[:, ::5])
    start, fits = started_by_ransac(before, after, seen, CAMERA)
    assert (fits >= 40).all()
    found = corner_motion(before, after, seen, CAMERA, start=start)
    assert SE3().distance(found.motion, motion).max() < 2e-3
    assert found.weight[:, ::5].median() < 0.01 * found.weight[:, 1::5].median()


def test_residual_distortion_is_removed():
    """A corner is moved outwards, and its right image so far that its disparity is short of a polynomial."""
    radial, short = (0.004, 0.03, -0.01), (0.4, 0.3, 0.0, 0.0, -2.0, 0.0, 1.0)
    camera = replace(CAMERA, radial=radial, disparity_offset=short)
    pixels = torch.tensor([[900.0, 250.0, 880.0, 250.0]])
    x, y = 300 / 700, 70 / 700
    square = x**2 + y**2
    factor = 1 - radial[0] - radial[1] * square - radial[2] * square**2
    right = (280 / 700) ** 2 + y**2
    beside = 280 * (1 - radial[0] - radial[1] * right - radial[2] * right**2)
    offset = 0.4 + 0.3 * x - 2.0 * x * y + square**2
    expected = torch.tensor([[600 + 300 * factor, 180 + 70 * factor, 300 * factor - beside + offset]])
    assert_close(camera.corners(pixels), expected)
    assert_close(CAMERA.corners(pixels), torch.tensor([[900.0, 250.0, 20.0]]))


def test_wrong_disparities_do_not_make_the_way_shorter():
    """Least squares on points that are wrong shorten the way, here by 6 of 10,000."""
    noise = CornerNoise(0.06, 0.0, 0.05, 0.0, 0.45, 0.0, freedom=200.0)
    before, after, seen, motion = drawn(1000)
    stays = noise.stereo * torch.randn(1000, 60)
    after[..., :2] += noise.pixel * torch.randn(1000, 60, 2)
    for corners in (before, after):
        corners[..., 2] += stays + noise.disparity * torch.randn(1000, 60)
    ahead = SE3().minus(corner_motion(before, after, seen, CAMERA, noise).motion, motion)[:, 5]
    assert ahead.mean().abs() < 3 * ahead.std() / 1000**0.5


def test_a_file_is_read_as_rows(tmp_path):
    """Three corners: one from the start, one that is new in row 2; row 3 repeats row 2, and the third is new there."""
    features = -torch.ones(4, 3, 5)
    features[:, 0] = torch.tensor([[10.0, 11.0, 12.0, 12.0, 13.0]])
    features[:, 1, 2:] = torch.tensor([[20.0, 20.0, 21.0]])
    features[:, 2, 3:] = torch.tensor([[30.0, 31.0]])
    stored = {"features": features, "K": torch.diag(torch.tensor([700.0, 700.0, 1.0])), "b": torch.tensor(0.5)}
    stored |= {
        "cam_T_imu": torch.eye(4),
        "rotational_velocity": torch.zeros(3, 5),
        "time_stamps": torch.arange(5)[None],
    }
    np.savez(tmp_path / "drive.npz", **{key: value.numpy() for key, value in stored.items()})
    rows, _ = read_corner_drive(tmp_path / "drive.npz")
    assert rows["motion_observed"].flatten().tolist() == [False, True, True, False, True]
    assert rows["seen"].sum(-1).tolist() == [0, 1, 1, 2, 3]
    assert rows["came_from"].tolist() == [[-1] * 3, [-1] * 3, [0, -1, -1], [0, -1, -1], [-1] * 3]
    assert rows["repeats"][4].tolist() == [1, 1, 0]


@pytest.mark.slow
@pytest.mark.skipif(not DRIVE.exists(), reason="the drive is not here")
def test_a_real_drive():
    """Odometry sequence 07: 400 rows of it, of which some repeat the corners of the row before."""
    rows, camera = read_corner_drive(DRIVE, 400)
    assert rows["motion_observed"].shape == (400, 1)
    assert 20 < (~rows["motion_observed"]).sum() < 60
    before, after = (camera.corners(rows["corners"][:, :, row]) for row in (0, 1))
    start, _ = started_by_ransac(before, after, rows["seen"], camera)
    found = corner_motions(rows, camera, start=start).motion
    matrices = torch.as_tensor(read_poses(KITTI / "poses" / "07.txt"))[:400]
    truth = torch.cat([quaternion_of(matrices[:, :3, :3]), matrices[:, :3, 3]], -1)
    errors = []
    for motion in (start, found):
        path = [truth[0]]
        for row in range(1, 400):
            if not rows["motion_observed"][row]:
                motion[row] = motion[row - 1]
            path.append(SE3().compose(path[-1], motion[row]))
        errors.append(kitti_devkit_error(torch.stack(path), truth))
    # OpenCV's poses with the last motion held over repeats: 1.77 % on the whole sequence.
    assert errors[0].translation < 3.0
    assert errors[1].translation < errors[0].translation
    replay = corner_replay({"07": rows.exclude("corners", "seen", "came_from", "repeats")})
    rollout = ReplayEnv(replay).rollout(20)
    assert_close(rollout["gyro"], rows["gyro"][: len(rollout)])
    assert rollout["motion_observed"].equal(rows["motion_observed"][: len(rollout)])
