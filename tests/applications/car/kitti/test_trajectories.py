"""Oracle: evo reads the files, and its errors of known offsets are these offsets."""

import numpy as np
import torch
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from torch_denkf.applications.car.kitti.trajectories import write_trajectory

READERS = {"kitti": file_interface.read_kitti_poses_file, "tum": file_interface.read_tum_trajectory_file}
TIMES = 0.103 * torch.arange(60, dtype=torch.float64)


def drive():
    """Returns a path that turns through more than a whole turn, float64 [60, 5]."""
    theta = torch.linspace(-0.5, 7.0, 60, dtype=torch.float64)
    step = torch.stack([theta.cos(), theta.sin()], -1)
    return torch.cat([step.cumsum(0), theta.unsqueeze(-1), torch.ones(60, 2, dtype=torch.float64)], -1)


def test_axes_are_those_of_kittis_camera_and_times_are_written(tmp_path):
    for layout, reader in READERS.items():
        read = reader(write_trajectory(tmp_path / layout, drive(), TIMES, layout=layout))
        np.testing.assert_allclose(read.positions_xyz[:, 2], drive()[:, 0], atol=1e-8)  # forward
        np.testing.assert_allclose(read.positions_xyz[:, 0], -drive()[:, 1], atol=1e-8)  # right
        # The camera looks along the path: half a step's turn from the chord that leads to the next pose.
        chord = np.diff(read.positions_xyz, axis=0)
        forward = np.stack([pose[:3, 2] for pose in read.poses_se3])[1:]
        assert (np.sum(chord * forward, -1) > 0.999 * np.linalg.norm(chord, axis=-1)).all()
    np.testing.assert_allclose(read.timestamps, TIMES, atol=1e-9)


def test_any_rotation_survives_both_layouts(tmp_path):
    rotations = Rotation.random(200, random_state=0).as_matrix()
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    poses = np.zeros((203, 4, 4))
    poses[:, :3, :3] = np.concatenate([rotations, half_turns])
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(203, 3))
    poses[:, 3, 3] = 1
    for layout, reader in READERS.items():
        for given in (poses, torch.from_numpy(poses[:, :3])):
            read = reader(write_trajectory(tmp_path / layout, given, np.arange(203.0), layout=layout))
            np.testing.assert_allclose(np.stack(read.poses_se3), poses, atol=1e-8)
