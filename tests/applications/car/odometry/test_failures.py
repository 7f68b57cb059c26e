"""A camera that fails: what is black counts as missing if asked to; dead reckoning holds the last reading."""

import math

import cv2
import numpy as np
import pytest
import torch

from tests.applications.car.odometry.test_tracking import calibration_of, frames_of
from torch_denkf.applications.car import read_kitti_drive, track, write_drives
from torch_denkf.applications.car.odometry.failing_drive import drive_scores, track_failing_drive, usual_failures
from torch_denkf.applications.car.odometry.failures import CameraFailure, fail_frames
from torch_denkf.applications.car.odometry.paths import read_path
from torch_denkf.cli.main import main
from torch_denkf.pretrained import from_pretrained


def test_static_occlusion_is_detected_and_ignored(tmp_path, capsys):
    """The share that is told is the box's; pairs without it are read as ever."""
    write_drives(tmp_path, ["town"], frames=14, size=(100, 300))
    drive = read_kitti_drive(tmp_path, "town", size=(100, 300), cache=None)
    images, calibration = frames_of(drive), calibration_of(drive)
    covered = [*fail_frames(images, [CameraFailure("box", 5, 9)])]
    box = np.mean(covered[6] != images[6])
    car = from_pretrained("car-odometry")
    clean, plain, repaired = (
        list(track(car, frames, calibration, repair=repair))
        for frames, repair in ((images, True), (covered, False), (covered, True))
    )
    assert not any(belief.hidden for belief in clean)
    for beliefs in (plain, repaired):
        shares = np.array([belief.hidden for belief in beliefs])
        assert np.flatnonzero(shares).tolist() == [6, 7, 8, 9]  # both pictures of a pair show it
        assert shares[6:10] == pytest.approx(box, rel=0.3)
    assert torch.equal(plain[4].reading, repaired[4].reading)
    assert not torch.equal(plain[7].reading, repaired[7].reading)
    assert torch.equal(plain[12].reading, repaired[12].reading)

    (tmp_path / "covered").mkdir()
    for number, frame in enumerate(covered):
        cv2.imwrite(str(tmp_path / f"covered/{number}.png"), frame)
    words = ["--calibration", str(tmp_path / "sequences/town/calib.txt"), "--camera", "image_2", "--fps", "9.7"]
    words += ["--out", str(tmp_path / "out"), "--no-pictures"]
    assert main(["odometry", str(tmp_path / "covered"), *words]) == 0
    assert "Something stands still before the camera in 4 frames, 6 to 9" in capsys.readouterr().out
    path = read_path(tmp_path / "out/path.csv")
    assert path["hidden"].flatten().numpy() == pytest.approx(shares, rel=1e-6)


def test_dead_reckoning_integrates_the_readings(checkpoint, drive):
    car = from_pretrained(checkpoint)
    failures = [CameraFailure("black", 6, 7)]
    tracked = track_failing_drive(car, drive, failures, seed=3)
    beliefs = list(track(car, fail_frames(frames_of(drive), failures), calibration_of(drive), black_level=8, seed=3))
    assert torch.equal(tracked["belief", "mean"], torch.stack([belief.mean for belief in beliefs]))
    x = y = theta = 0.0
    held = beliefs[1].reading
    for belief, place in zip(beliefs[1:], tracked["dead_reckoning"][1:], strict=True):
        held = held if belief.reading is None else belief.reading
        v, rate = held.tolist()
        x += v * 0.103 * math.cos(theta + rate * 0.103 / 2)
        y += v * 0.103 * math.sin(theta + rate * 0.103 / 2)
        theta += rate * 0.103
        assert place.tolist() == pytest.approx([x, y, theta], abs=2e-3)
    truth = tracked["state"]
    assert truth[0, :3].tolist() == [0.0, 0.0, 0.0]
    steps = drive["state"][1:, :2] - drive["state"][:-1, :2]
    scores = drive_scores(tracked)
    assert scores["way_m"] == pytest.approx(float(steps.norm(dim=-1).sum()), rel=1e-5)
    assert scores["reckoned_end_m"] == pytest.approx(math.dist((x, y), truth[-1, :2].tolist()), abs=5e-3)
    inside = (tracked["belief", "mean"] - truth).abs() <= 1.6449 * tracked["belief", "var"].sqrt()
    assert scores["held_v"] == pytest.approx(float(inside[1:, 3].float().mean()), abs=1e-6)
    assert len(usual_failures(240)) == 3
