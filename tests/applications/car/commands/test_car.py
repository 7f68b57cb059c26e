"""train, evaluate, odometry and plot: what they leave is what the library's functions give."""

import csv
import json
import re
import shlex
import shutil

import cv2
import numpy as np
import pytest
import torch
from evo.core import sync
from evo.tools import file_interface

from torch_denkf.applications.car import read_kitti_drive, track
from torch_denkf.applications.car.odometry.evaluation import evaluate_car_filter
from torch_denkf.applications.car.odometry.images import read_camera, read_frames, read_times
from torch_denkf.applications.car.odometry.paths import read_path
from torch_denkf.cli.main import main
from torch_denkf.pretrained import from_pretrained

SIZE = (25, 75)


def odometry(kitti, checkpoint, out, *words):
    drive = kitti / "sequences/b"
    given = ["odometry", drive / "image_2", "--calibration", drive / "calib.txt", "--checkpoint", checkpoint]
    return main([str(word) for word in (*given, "--out", out, *words)])


def test_train_leaves_a_filter_that_evaluate_reads(kitti, tmp_path, capsys):
    out = tmp_path / "car"
    few = shlex.split("--sensor-updates 2 --filter-updates 2 --end-to-end-updates 1 --length 4 --size 25 75 --seed 5")
    assert main(["train", "--root", str(kitti), "--out", str(out), *few]) == 0
    said = capsys.readouterr().out
    assert "roles: validation: " in said
    assert f"denkf evaluate --checkpoint {out}" in said
    training = json.loads((out / "config.json").read_text())["training"]
    assert training["seed"] == 5
    assert training["command"] == f"denkf train --root {kitti} --out {out} {' '.join(few)}"

    words = ["--root", str(kitti), "--drives", "a", "--window", "6", "--draws", "2", "--out", str(tmp_path / "e")]
    assert main(["evaluate", "--checkpoint", str(out), *words]) == 0
    table = capsys.readouterr().out
    assert table.startswith("| drive | method | steps | m/m |")
    with (tmp_path / "e/evaluation.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    cache = tmp_path / "e/cache"
    expected, _ = evaluate_car_filter(
        from_pretrained(out), kitti, ["a"], cache=cache, draws=2, window=6, progress=False
    )
    for row, wanted in zip(rows, expected, strict=True):
        assert row["method"] == wanted["method"]
        assert float(row["translation_m_per_m"]) == wanted["translation_m_per_m"]
    assert table.splitlines()[2] in (tmp_path / "e/evaluation.md").read_text()

    assert main(["train", "--root", str(kitti), "--out", str(out), *few[:-1], "6"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert "is of another training: seed (5, now 6)" in err
    assert main(["train", "--root", str(kitti), "--test", "a", "--out", str(tmp_path / "x"), *few]) == 2
    assert "2 drives are too few" in capsys.readouterr().err


def test_odometry_leaves_the_belief_in_all_files(kitti, checkpoint, tmp_path, capsys):
    drive = kitti / "sequences/b"
    assert odometry(kitti, checkpoint, tmp_path, "--times", drive / "times.txt", "--seed", "4") == 0
    said = capsys.readouterr().out
    assert "12 steps, 0 without a reading" in said
    frames = [image[0].numpy() for image in read_kitti_drive(kitti, "b", size=SIZE, colour=False, cache=None)["image"]]
    source = list(read_frames(drive / "image_2"))  # in colour, as the files are
    assert len(source) == len(frames) == 12
    calibration, times = read_camera(drive / "calib.txt"), read_times(drive / "times.txt")
    beliefs = list(track(from_pretrained(checkpoint), source, calibration, times=times, seed=4))
    path = read_path(tmp_path / "path.csv")
    mean, var = (torch.stack([getattr(belief, name) for belief in beliefs]).double() for name in ("mean", "var"))
    torch.testing.assert_close(path["belief", "mean"], mean, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(path["belief", "var"], var, rtol=1e-6, atol=1e-12)
    members = torch.stack([belief.ensemble for belief in beliefs]).double()
    torch.testing.assert_close(path["belief", "cov"][-1, :2, :2], members[-1, :, :2].T.cov(), rtol=1e-4, atol=1e-9)
    assert path["observed"].flatten().tolist() == [False] + [True] * 11
    assert path["time"].flatten().tolist() == pytest.approx(times)

    # evo reads both trajectory files, and they agree with the belief: KITTI's x is to the right, z forward.
    kitti_path = file_interface.read_kitti_poses_file(str(tmp_path / "path_kitti.txt"))
    tum_path = file_interface.read_tum_trajectory_file(str(tmp_path / "path_tum.txt"))
    for evo_path in (kitti_path, tum_path):
        positions = evo_path.positions_xyz
        np.testing.assert_allclose(positions[:, 2], mean[:, 0], atol=1e-6)
        np.testing.assert_allclose(positions[:, 0], -mean[:, 1], atol=1e-6)
    one, other = sync.associate_trajectories(tum_path, tum_path)
    assert len(one.timestamps) == len(other.timestamps) == 12

    for name in ("path.png", "bands.png"):
        assert cv2.imread(str(tmp_path / name)).std() > 1
        (tmp_path / name).unlink()
    assert main(["plot", str(tmp_path)]) == 0
    assert (tmp_path / "path.png").is_file()
    assert main(["plot", str(tmp_path / "path.csv"), "--out", str(tmp_path / "pictures")]) == 0
    assert (tmp_path / "pictures/bands.png").is_file()


def test_missing_numbers_are_missing_frames(kitti, checkpoint, tmp_path, capsys):
    shutil.copytree(kitti / "sequences/b", tmp_path / "b")
    (tmp_path / "b/image_2/000000.png").unlink()
    (tmp_path / "b/image_2/000006.png").unlink()
    (tmp_path / "b/image_2/000007.png").write_bytes(b"broken")
    words = ["--calibration", tmp_path / "b/calib.txt", "--times", tmp_path / "b/times.txt", "--no-pictures"]
    words = ["odometry", tmp_path / "b/image_2", *words, "--checkpoint", checkpoint, "--out", tmp_path]
    assert main([str(word) for word in words]) == 0
    said = capsys.readouterr()
    assert "warning: " in said.err
    assert "000007.png cannot be read as an image; its frame counts as missing" in said.err
    assert "11 steps, 2 without a reading" in said.out
    path = read_path(tmp_path / "path.csv")
    assert path["time"][0, 0] == pytest.approx(0.103)
    assert path["observed"].flatten().tolist() == [False, *[True] * 4, False, False, *[True] * 4]


def test_mistakes_are_one_line(kitti, checkpoint, tmp_path, capsys):
    drive = kitti / "sequences/b"
    large = tmp_path / "large.txt"
    large.write_text("fx=718 fy=718 cx=607 cy=185")
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("fx: 700\n")
    many = tmp_path / "many.txt"
    many.write_text("".join(f"{0.1 * n}\n" for n in range(99)))
    (tmp_path / "drive.mp4").write_bytes(b"no video")
    (tmp_path / "path.csv").write_text("a,b\n1,2\n")
    times = ["--times", drive / "times.txt"]
    cases = [
        (["--checkpoint", tmp_path / "empty", *times], r"no (trained )?filter .*empty"),
        (["--calibration", tmp_path / "none.txt", *times], r"no such file or folder: calibration .*none\.txt"),
        (["--calibration", tmp_path / "notes.txt", *times], "does not say fy, cx, cy"),
        (["--calibration", large, *times], "does not belong to images of 75 x 25 pixels"),
        (["--height", "165", *times], "height must be .* It is that of the camera over the road, in m"),
        (["--fps", "2"], r"frames are 0\.5 s apart, but the filter moves in steps of 0\.103 s"),
        (["--fps", "10", *times], "--fps or --times, not both"),
        (["--times", many], "many.txt has 99 times, but .*image_2 has 12 frames; pass a row for each"),
        (["--times", large], r"large\.txt:1: expected a time in s"),
        (["--times", kitti / "poses/b.txt"], "times must increase"),
    ]
    for words, pattern in cases:
        assert odometry(kitti, checkpoint, tmp_path / "out", *words) == 2, words
        err = capsys.readouterr().err
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        assert re.search(pattern, err), err
    given = ["--calibration", str(drive / "calib.txt"), "--checkpoint", str(checkpoint), "--out", str(tmp_path / "o")]
    for frames, pattern in (
        ("none", "no such file or folder: frames"),
        ("empty", "no images in"),
        ("drive.mp4", "no video that OpenCV"),
    ):
        assert main(["odometry", str(tmp_path / frames), *given]) == 2
        lines = capsys.readouterr().err.splitlines()  # OpenCV has a line of its own for a broken video
        assert pattern in lines[-1]
    assert main(["plot", str(tmp_path / "path.csv")]) == 2
    assert "has no columns frame, time_s" in capsys.readouterr().err
    assert main(["plot", str(tmp_path / "empty")]) == 2
    assert "no path" in capsys.readouterr().err
    assert main(["evaluate", "--checkpoint", str(checkpoint), "--root", str(tmp_path)]) == 2
    assert "error: no folder" in capsys.readouterr().err


def test_calibration_files(kitti, tmp_path):
    file = tmp_path / "camera"
    for text in (
        '{"fx": 718.5, "fy": 719, "cx": 607.25, "cy": 185}',
        "fx: 718.5\nfy: 719\n# cx: 1\ncx: 607.25\ncy: 185\n",
        "fx = 718.5, fy = 719, cx = 607.25, cy = 185",
        "718.5 719 607.25 185\n",
        "718.5, 719, 607.25, 185",
    ):
        file.write_text(text)
        assert read_camera(file) == (718.5, 719.0, 607.25, 185.0), text
    row = "718 0 607 0 0 719 185 0 0 0 1 0"
    file.write_text(f"P0: {row}\nP1: {row}\n")
    assert read_camera(file) == (718.0, 719.0, 607.0, 185.0)
    file.write_text(f"P0: {row}\nP2: {row.replace('718', '700')}\n")
    assert read_camera(file, "image_2") == (700.0, 719.0, 607.0, 185.0)
    with pytest.raises(ValueError, match="several cameras, image_0, image_2, that differ; say which"):
        read_camera(file)
    for text, message in (("{", "is not JSON"), ("fx: -1 fy: 1 cx: 1 cy: 1", "must be positive"), ("", "does not say")):
        file.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_camera(file)
