"""train, evaluate, odometry and plot: what they leave is what the library's functions give."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest
import torch

from tests.applications.car.conftest import SIZE, WORDS
from torch_denkf.applications.car import read_kitti_drive, track
from torch_denkf.applications.car.odometry.images import read_camera, read_frames, read_times
from torch_denkf.applications.car.odometry.paths import read_path
from torch_denkf.cli.command import alone_in
from torch_denkf.cli.main import main
from torch_denkf.pretrained import from_pretrained


def odometry(root, checkpoint, out, *words):
    drive = root / "sequences/b"
    given = ["odometry", drive / "image_2", "--calibration", drive / "calib.txt", "--checkpoint", checkpoint]
    return main([str(word) for word in (*given, "--out", out, *words)])


def test_training_prints_roles_and_command(root, training, capsys):
    folder, said = training
    assert "roles: validation: " in said
    assert f"denkf evaluate --checkpoint {folder}" in said
    recorded = json.loads((folder / "config.json").read_text())["training"]
    assert recorded["seed"] == 3
    assert recorded["command"] == f"denkf train --root {root} --out {folder} {WORDS}"
    assert main(["train", "--root", str(root), "--out", str(folder), *WORDS.split(), "--seed", "6"]) == 2
    assert "is of another training: seed (3, now 6)" in capsys.readouterr().err
    assert main(["train", "--root", str(root), "--test", "a", "--out", str(folder / "x"), *WORDS.split()]) == 2
    assert "2 drives are too few" in capsys.readouterr().err


def test_odometry_leaves_the_belief_in_all_files(root, checkpoint, tmp_path, capsys):
    drive = root / "sequences/b"
    assert odometry(root, checkpoint, tmp_path, "--times", drive / "times.txt", "--seed", "4") == 0
    said = capsys.readouterr().out
    assert "16 steps, 0 without a reading" in said
    frames = [image[0].numpy() for image in read_kitti_drive(root, "b", size=SIZE, colour=False, cache=None)["image"]]
    source = list(read_frames(drive / "image_2"))  # in colour, as the files are
    assert len(source) == len(frames) == 16
    calibration, times = read_camera(drive / "calib.txt"), read_times(drive / "times.txt")
    beliefs = list(track(from_pretrained(checkpoint), source, calibration, times=times, seed=4))
    path = read_path(tmp_path / "path.csv")
    mean, var = (torch.stack([getattr(belief, name) for belief in beliefs]).double() for name in ("mean", "var"))
    torch.testing.assert_close(path["belief", "mean"], mean, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(path["belief", "var"], var, rtol=1e-6, atol=1e-12)
    members = torch.stack([belief.ensemble for belief in beliefs]).double()
    torch.testing.assert_close(path["belief", "cov"][-1, :2, :2], members[-1, :, :2].T.cov(), rtol=1e-4, atol=1e-9)
    assert path["observed"].flatten().tolist() == [False] + [True] * 15
    assert path["time"].flatten().tolist() == pytest.approx(times)

    # KITTI's x is to the right, z forward.
    poses, stamped = (np.loadtxt(tmp_path / f"path_{layout}.txt") for layout in ("kitti", "tum"))
    for positions in (poses[:, 3::4], stamped[:, 1:4]):
        np.testing.assert_allclose(positions[:, 2], mean[:, 0], atol=1e-6)
        np.testing.assert_allclose(positions[:, 0], -mean[:, 1], atol=1e-6)
    np.testing.assert_allclose(stamped[:, 0], times, atol=1e-6)

    for name in ("path.png", "bands.png"):
        assert cv2.imread(str(tmp_path / name)).std() > 1
        (tmp_path / name).unlink()
    assert main(["plot", str(tmp_path)]) == 0
    assert (tmp_path / "path.png").is_file()
    assert main(["plot", str(tmp_path / "path.csv"), "--out", str(tmp_path / "pictures")]) == 0
    assert (tmp_path / "pictures/bands.png").is_file()


def test_missing_numbers_are_missing_frames(root, checkpoint, tmp_path, capsys):
    shutil.copytree(root / "sequences/b", tmp_path / "b")
    (tmp_path / "b/image_2/000000.png").unlink()
    (tmp_path / "b/image_2/000006.png").unlink()
    (tmp_path / "b/image_2/000007.png").write_bytes(b"broken")
    words = ["--calibration", tmp_path / "b/calib.txt", "--times", tmp_path / "b/times.txt", "--no-pictures"]
    words = ["odometry", tmp_path / "b/image_2", *words, "--checkpoint", checkpoint, "--out", tmp_path]
    assert main([str(word) for word in words]) == 0
    said = capsys.readouterr()
    assert "warning: " in said.err
    assert "000007.png cannot be read as an image; its frame counts as missing" in said.err
    assert "15 steps, 2 without a reading" in said.out
    path = read_path(tmp_path / "path.csv")
    assert path["time"][0, 0] == pytest.approx(0.103)
    assert path["observed"].flatten().tolist() == [False, *[True] * 4, False, False, *[True] * 8]


MISTAKES = {
    "--calibration CAMERA --fps 10": "does not belong to images of 75 x 25 pixels",
    "--fps 10 --times CAMERA": "--fps or --times, not both",
}


@pytest.mark.parametrize(("words", "pattern"), MISTAKES.items(), ids=MISTAKES)
def test_mistakes_are_one_line(words, pattern, root, checkpoint, tmp_path, capsys):
    (tmp_path / "camera.txt").write_text("fx=718 fy=718 cx=607 cy=185")
    words = words.replace("CAMERA", str(tmp_path / "camera.txt")).split()
    assert odometry(root, checkpoint, tmp_path / "out", *words) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert re.search(pattern, err), err


def test_a_second_command_in_a_folder_raises(root, checkpoint, tmp_path, capsys):
    """``tests/deployment/test_files.py`` shows that a killed one is not in the way."""
    with alone_in(tmp_path / "out"):
        assert odometry(root, checkpoint, tmp_path / "out", "--fps", "9.7") == 2
    assert "out: another process is writing to it" in capsys.readouterr().err


def test_calibration_files(tmp_path):
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
