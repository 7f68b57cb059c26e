"""Mirrored drives: against mirrored poses, mirrored points and the flow of mirrored images."""

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.applications.car import dead_reckoning
from torch_denkf.applications.car.kitti.mirror import mirror_drive
from torch_denkf.applications.car.kitti.render import random_drive


def test_the_path_is_the_mirror_image():
    """Velocities of the mirrored state, integrated from the mirrored start, lead along the mirrored path."""
    state = torch.from_numpy(random_drive(300, np.random.default_rng(1)))
    state[:, :2] += torch.tensor([3.0, 7.0])
    assert state[:, 4].abs().max() > 0.1  # it bends
    mirrored = mirror_drive(TensorDict({"state": state}, [300]))["state"]
    path = dead_reckoning(mirrored[:, 3:], mirrored[0, :3], 0.103)
    torch.testing.assert_close(path[:, 0], state[:, 0], atol=1e-6, rtol=0)
    torch.testing.assert_close(path[:, 1], -state[:, 1], atol=1e-6, rtol=0)
    torch.testing.assert_close(path[:, 2], -state[:, 2], atol=1e-6, rtol=0)


def test_a_mirrored_point_is_seen_in_the_mirrored_column():
    """u = fx X / Z + cx: a point at -X is seen at W - 1 - u, where flipping puts the pixel."""
    width, depth = 30, 8.0
    calibration = torch.tensor([[16.0, 18.0, 11.0, 4.0]])
    image = torch.zeros(1, 1, 10, width, dtype=torch.uint8)
    column = int(16 * -3.0 / depth + 11)  # 5
    image[..., column] = 255
    mirrored = mirror_drive(TensorDict({"image": image, "calibration": calibration}, [1]))
    fx, _, cx, _ = mirrored["calibration"][0].tolist()
    assert cx == 18
    assert mirrored["image"][0, 0, 0].nonzero().item() == fx * 3.0 / depth + cx == 24
    assert calibration[0, 2] == 11  # the drive itself is as it was
    assert mirrored["calibration"][0, [0, 1, 3]].tolist() == [16, 18, 4]
