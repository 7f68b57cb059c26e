"""The motion that stereo corners show: of drawn points, and of a real drive."""

import pytest
import torch

from tests.real_data import KITTI, SHARED
from torch_denkf.applications.car import kitti_devkit_error
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.drive import corner_replay, read_corner_drive
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motion, started_by_ransac
from torch_denkf.applications.car.kitti.files import read_poses
from torch_denkf.functional.manifolds import SE3, SO3, quaternion_of, rotate

CAMERA = StereoCamera(700.0, (600.0, 180.0), 0.54)
DRIVE = SHARED / "kitti_inertial" / "0027.npz"


@pytest.fixture(autouse=True)
def _double(float64):
    return


def drawn(batch=20, count=60, noise=None, seed=0):
    """Points ahead, a motion of a metre, and the corners of both rows."""
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


def test_a_camera_projects_what_it_has_seen():
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


@pytest.mark.skipif(not DRIVE.exists(), reason="the drive is not here")
def test_a_real_drive():
    """Odometry sequence 07: 400 rows of it, of which some repeat the corners of the row before."""
    rows, camera = read_corner_drive(DRIVE, 400)
    assert rows["motion_observed"].shape == (400, 1)
    assert 20 < (~rows["motion_observed"]).sum() < 60
    corners, offset = rows["corners"], rows["corners"][:, :, 0, 1] - rows["corners"][:, :, 0, 3]
    before, after = (camera.corners(corners[:, :, row]) for row in (0, 1))
    start, _ = started_by_ransac(before, after, rows["seen"], camera)
    found = corner_motion(before, after, rows["seen"], camera, offset=offset, start=start).motion
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
    replay = corner_replay({"07": rows})
    assert len(replay) == 400
