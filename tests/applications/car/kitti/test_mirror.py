"""Mirrored drives: against mirrored poses, mirrored points and the flow of mirrored images."""

import torch
from tensordict import TensorDict

from torch_denkf.applications.car.kitti.mirror import mirror_drive


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


def test_corners_of_a_mirrored_world_turn_the_other_way():
    frame = TensorDict({"two_view": torch.tensor([0.05, 0.01, 0.02, 0.03, -0.02, 1e-3, 1e-3, 0.9])})
    mirrored = mirror_drive(frame)["two_view"]
    torch.testing.assert_close(mirrored, torch.tensor([-0.05, 0.01, -0.02, -0.03, -0.02, 1e-3, 1e-3, 0.9]))
