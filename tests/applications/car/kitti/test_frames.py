"""Pixels and differences, by hand."""

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.applications.car.kitti.frames import drive_frames


def make_drive(rows=8, missing=(), channels=3, size=(4, 6), seed=0):
    generator = torch.Generator().manual_seed(seed)
    valid = torch.ones(rows, 1, dtype=torch.bool)
    valid[list(missing)] = False
    image = torch.randint(0, 256, (rows, channels, *size), generator=generator, dtype=torch.uint8)
    return TensorDict(
        {
            "image": torch.where(valid[..., None, None], image, 0),
            "frame_valid": valid,
            "state": torch.randn(rows, 5, generator=generator),
            "time": 0.1 * torch.arange(rows, dtype=torch.float64).unsqueeze(-1),
            "dt": torch.full((rows, 1), 0.1),
        },
        [rows],
    )


@pytest.mark.parametrize("channels", [1, 3])
def test_pixels_are_the_frame_and_its_difference(channels):
    drive = make_drive(channels=channels)
    frames = drive_frames(drive)
    assert frames["pixels"].shape == (8, 2 * channels, 4, 6)
    image = drive["image"].double() / 255
    frame, difference = frames["pixels"].double().split(channels, 1)
    torch.testing.assert_close(frame, image, atol=1e-6, rtol=0)
    torch.testing.assert_close(difference[1:], image[1:] - image[:-1], atol=1e-6, rtol=0)
    assert (difference[0] == 0).all()
    assert difference.min() < 0  # signed
    assert frames["observed"].flatten().tolist() == [False] + [True] * 7
    assert frames["is_init"].flatten().tolist() == [True] + [False] * 7
    assert (frames["state"] == drive["state"]).all()
    assert (frames["time"] == drive["time"]).all()


def test_a_missing_frame_blinds_two_rows():
    drive = make_drive(missing=[3])
    frames = drive_frames(drive)
    assert frames["observed"].flatten().tolist() == [False, True, True, False, False, True, True, True]
    assert (frames["pixels"][3] == 0).all()
    assert (frames["pixels"][4, 3:] == 0).all()
    torch.testing.assert_close(frames["pixels"][4, :3], drive["image"][4] / 255)
    # Not even what a damaged file may have left there is shown.
    drive["image"][3] = 77
    assert (drive_frames(drive)["pixels"] == frames["pixels"]).all()
