"""Oracles: image_motion by hand, row by row, and the same drive in colour, mirrored, or through other intrinsics."""

import cv2
import numpy as np
import pytest
import torch

import torch_denkf.applications.car.kitti.motion as motion_module
from tests.applications.car.vision.drives_for_tests import rendered
from torch_denkf.applications.car import with_motion
from torch_denkf.applications.car.vision.motion import image_motion
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE, ROAD_SHAPE

cv2.setNumThreads(1)
ROWS = 8


@pytest.fixture
def drive():
    return rendered("road9", 60)[20 : 20 + ROWS].clone()


@pytest.fixture
def count(monkeypatch):
    """Counts the calls of image_motion."""
    calls = []

    def counted(*args, **kwargs):
        calls.append(kwargs)
        return image_motion(*args, **kwargs)

    monkeypatch.setattr(motion_module, "image_motion", counted)
    return calls


def test_rows_are_image_motion_of_neighbours(drive):
    out = with_motion(drive, height=1.5, cache=None)
    assert out["flow"].shape == (ROWS, *FLOW_SHAPE)
    assert out["road"].shape == (ROWS, *ROAD_SHAPE)
    assert out["flow"].dtype == out["road"].dtype == torch.float16
    images = drive["image"][:, 0].numpy()
    for row in range(1, ROWS):
        calibration = drive["calibration"][row].tolist()
        flow, road = image_motion(images[row - 1], images[row], calibration, height=1.5)
        assert np.abs(flow).max() > 0.01
        assert out["flow"][row].equal(torch.from_numpy(flow).half())
        assert out["road"][row].equal(torch.from_numpy(road).half())
    assert (out["flow"][0] == 0).all()
    assert (out["road"][0] == 0).all()
    for key in drive.keys():  # noqa: SIM118
        assert out[key] is drive[key]  # a shallow copy
    assert "flow" not in drive


def one_pixel(drive):
    drive["image"][3, 0, 20, 70] += 1


def mask(drive):
    drive["frame_valid"][3] = False


def calibration(drive):
    drive["calibration"][:, 1] *= 1.001


def wider(drive):
    """Keeps the bytes in another shape."""
    drive["image"] = drive["image"].reshape(ROWS, 1, 75, 100)


@pytest.mark.parametrize("change", [one_pixel, mask, calibration, wider])
def test_cache_key_depends_on_all_settings(drive, tmp_path, count, change):
    with_motion(drive, cache=tmp_path)
    changed = drive.clone()
    change(changed)
    count.clear()
    out = with_motion(changed, cache=tmp_path)
    assert count
    assert out["road"].equal(with_motion(changed, cache=None)["road"])
    assert len(list(tmp_path.glob("motion-*"))) == 2


def test_mirrored_images_give_the_mirrored_flow():
    drive = rendered("road9", 60)[20:40].clone()
    out = with_motion(drive, cache=None)[1:]
    drive["image"] = drive["image"].flip(-1)
    drive["calibration"][:, 2] = 149 - drive["calibration"][:, 2]
    mirrored = with_motion(drive, cache=None)[1:]
    expected = out["flow"].float().flip(-1) * torch.tensor([-1.0, 1.0, 1.0]).reshape(3, 1, 1)
    difference = (mirrored["flow"].float() - expected).abs()
    # DIS starts its patches at the left and sweeps from there, so that where the match is poor (at the border, in
    # featureless places) it ends up elsewhere; half of the image must agree to 1/10 of a pixel of 1/120.
    assert difference[:, :2].median() < 1e-3
    assert (difference[:, :2] < 1e-2).float().mean() > 0.9
    assert out["flow"][:, 0].float().abs().median() > 1e-2
    # The table sees the flow only through the median turn.
    assert (mirrored["road"] - out["road"]).abs().max() < 0.1
    assert (mirrored["road"] - out["road"]).abs().float().mean() < 0.01
