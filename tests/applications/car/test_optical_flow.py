"""Oracles: with_motion on the drive that is replayed, and image_motion on frames by hand."""

import cv2
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import Compose, InitTracker, TransformedEnv

from tests.applications.car.vision.drives_for_tests import rendered
from tests.filters.factories import FixedEnsemble
from torch_denkf.applications.car import (
    FlowSensor,
    KITTIReplayEnv,
    OpticalFlow,
    UnicycleMotion,
    UnicycleTransition,
    with_motion,
)
from torch_denkf.applications.car.kitti.frames import frames_at
from torch_denkf.applications.car.vision.motion import image_motion
from torch_denkf.filters import DEnKF
from torch_denkf.modules import DiagonalNoise, EnsembleAnalysis, Select, StochasticMLP
from torch_denkf.transforms import DEnKFTransform

cv2.setNumThreads(1)
BELIEF = [("belief", "ensemble"), ("belief", "mean"), ("belief", "var")]
DT = 0.103


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
    """Keeps the numbers but for half precision, in which a drive's motion is kept."""
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


# ------------------------------------------------------------------------------------------------------ in a filter


def flow_filter(layer):
    """The study's filter; with layer "none" and a fixed start it has no randomness at all."""
    torch.manual_seed(0)
    members = torch.randn(16, 5) * torch.tensor([0.0, 0.0, 0.0, 1.0, 0.05]) + torch.tensor([0.0, 0, 0, 8.0, 0])
    sensor = FlowSensor(dt=DT, ensemble_size=16, layer=layer)
    return DEnKF(
        transition=UnicycleTransition(StochasticMLP(2, 2, layer=layer, output_gain=0.1), dt=DT),
        sensor=sensor,
        observation=Select([3, 4]),
        noise=DiagonalNoise(2, r=[0.5, 0.02], in_features=sensor.encoding_features, in_key=("sensor", "encoding")),
        analysis=TensorDictSequential(EnsembleAnalysis("sensor", belief_prefix="analysis"), UnicycleMotion(DT)),
        initial=FixedEnsemble(members),
    )


def filtered(drive, filter, **kwargs):
    base = KITTIReplayEnv(drive, **kwargs)
    return TransformedEnv(base, Compose(OpticalFlow(calibration(drive)), InitTracker(), DEnKFTransform(filter)))


def test_a_filter_over_a_replay_is_the_filter_on_the_drives_motion():
    drive, filter = a_drive(), flow_filter("none").eval()
    starts, length = [0, 5], 12
    env = filtered(drive, filter, batch_size=[2], start=starts, length=length)
    rollout = env.rollout(100)
    assert rollout["observed"].sum(1).flatten().tolist() == [length - 1 - 3, length - 1 - 2]
    # Steps equal the sequence, on the very same readings.
    transform = env.transform[-1]
    frames = rollout.select("flow", "road", "observed", "is_init")
    sequence = transform(frames.copy())
    for key in BELIEF:
        torch.testing.assert_close(sequence[key], rollout[key], rtol=1e-5, atol=1e-4)
    # And what was computed for the drive before hand, in half precision, gives the same belief but for that.
    motion = with_motion(drive, cache=None)
    for key in ("flow", "road"):
        frames[key] = torch.stack([motion[key][start : start + length - 1] for start in starts])
    sequence = transform(frames)
    difference = (sequence["belief", "mean"] - rollout["belief", "mean"]).abs().amax((0, 1))
    assert (difference < torch.tensor([0.05, 0.02, 0.002, 0.05, 0.002])).all(), difference
    # It follows the car, already before any training, from members around 8 m/s that do not turn.
    belief, truth = rollout["next", "belief", "mean"], rollout["next", "state"]
    assert truth[..., 4].max() < -0.2
    assert belief[..., 4].max() < -0.15
    assert (belief[:, -1, 3] - truth[:, -1, 3]).abs().max() < 1.5
