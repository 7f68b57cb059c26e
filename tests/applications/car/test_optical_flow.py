"""Oracles: with_motion on the drive that is replayed, and image_motion on frames by hand."""

import cv2
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from tests.applications.car.vision.drives_for_tests import rendered
from torch_denkf.applications.car import KITTIReplayEnv, OpticalFlow, with_motion
from torch_denkf.applications.car.kitti.frames import frames_at
from torch_denkf.applications.car.vision.motion import image_motion

cv2.setNumThreads(1)


def a_drive(colour=False):
    """20 frames, of which number 8 is missing."""
    drive = rendered("road9", 60, colour)[20:40].clone()
    drive["image"][8], drive["frame_valid"][8] = 0, False
    return drive


def calibration(drive):
    return drive["calibration"][0].tolist()


def flow_env(drive, **kwargs):
    return TransformedEnv(KITTIReplayEnv(drive, **kwargs), OpticalFlow(calibration(drive)))


def same(out, expected, keys=("flow", "road")):
    """Keeps the numbers except for half precision, in which a drive's motion is kept."""
    for key in keys:
        assert out[key].dtype == torch.float32
        assert out[key].half().equal(expected[key]), key


@pytest.mark.parametrize("colour", [False, True])
def test_replayed_frames_have_the_drives_motion(colour):
    drive = a_drive(colour)
    expected = with_motion(drive, cache=None)
    assert expected["flow"].abs().amax((1, 2, 3)).gt(0.01).tolist() == [k not in (0, 8, 9) for k in range(20)]
    rollout = flow_env(drive).rollout(100)
    same(rollout, expected[:-1])
    same(rollout["next"], expected[1:])


def test_frames_that_are_not_observed_are_zero_and_not_read():
    drive = a_drive()
    frames = frames_at(drive, torch.arange(10, 14))
    whole = OpticalFlow(calibration(drive))(frames.exclude("observed"))  # without a mask all are read
    same(whole, with_motion(drive, cache=None)[10:14])
    frames["pixels"][2] = torch.nan
    frames["observed"][2] = False
    out = OpticalFlow(calibration(drive))(frames)
    for key in ("flow", "road"):
        assert (out[key][2] == 0).all()
        assert out[key][[0, 1, 3]].equal(whole[key][[0, 1, 3]])


def test_height_calibration_and_keys_by_hand():
    rng = np.random.default_rng(0)
    previous, current = (cv2.GaussianBlur(rng.integers(0, 256, (50, 150)).astype(np.uint8), (0, 0), 1) for _ in "ab")
    numbers = (90.0, 80.0, 70.0, 20.0)
    flow, road = image_motion(previous, current, numbers, height=1.2)
    frame, before = (torch.from_numpy(image).float() / 255 for image in (current, previous))
    td = TensorDict({"camera": {"pixels": torch.stack([frame, frame - before])}, "there": torch.tensor([True])})
    transform = OpticalFlow(
        torch.tensor(numbers), height=1.2, in_key=("camera", "pixels"), out_keys=("a", ("b", "c")), observed_key="there"
    )
    out = transform(td.copy())
    assert out["a"].equal(torch.from_numpy(flow))
    assert out["b", "c"].equal(torch.from_numpy(road))
    assert (transform(td.set("there", torch.tensor([False])))["a"] == 0).all()
