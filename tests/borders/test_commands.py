"""Checks the words and files of commands: the message names the option or the file."""

import pytest

from torch_denkf.applications.car.odometry.paths import PATH_COLUMNS
from torch_denkf.cli.main import main

EMPTY = [
    ("odometry", "--checkpoint"),
    ("odometry", "--calibration"),
    ("evaluate", "--checkpoint"),
    ("evaluate", "--root"),
    ("render-kitti", "--poses"),
    ("train", "--out"),
    ("collect-ur5", "--out"),
    ("plot", "--out"),
]


@pytest.mark.parametrize(("command", "option"), EMPTY)
def test_an_empty_name_is_not_the_working_folder(command, option, capsys):
    assert main([command, option, ""]) == 2
    assert f"error: argument {option}: must not be empty; see denkf {command} --help" in capsys.readouterr().err


def test_numbers_that_another_option_hides(capsys):
    assert main(["collect-ur5", "--out", "x", "--no-pixels", "--frames", "-1"]) == 2
    assert "error: --frames must be a whole number, at least 0; got -1" in capsys.readouterr().err


def test_drives_without_a_root(tmp_path, capsys):
    assert main(["train", "--out", str(tmp_path), "--rendered", "3", "--test", "09"]) == 2
    err = capsys.readouterr().err
    assert "['09']" in err
    assert "--root" in err
    assert list(tmp_path.iterdir()) == []


def test_images_without_poses(tmp_path, capsys):
    (tmp_path / "sequences" / "town" / "image_2").mkdir(parents=True)
    assert main(["evaluate", "--root", str(tmp_path)]) == 2
    message = f"error: no drive below {tmp_path} has both images and poses: no poses/town.txt\n"
    assert capsys.readouterr().err == message


def row(**changed):
    return ",".join(str(changed.get(name, 1)) for name in PATH_COLUMNS)


@pytest.mark.parametrize("byte", [b"\xff", b"\xcf"])
def test_a_path_that_is_no_text(tmp_path, byte, capsys):
    file = tmp_path / "path.csv"
    file.write_bytes(",".join(PATH_COLUMNS).encode() + b"\n" + row().encode() + byte + b"\n")
    assert main(["plot", str(file)]) == 2
    assert f"error: {file}:2 is no text in UTF-8 (byte 0x{byte[0]:02x})" in capsys.readouterr().err
