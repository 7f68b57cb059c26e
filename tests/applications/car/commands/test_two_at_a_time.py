"""Two commands in one folder: the second is refused, and a killed one is not in the way of the next."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from torch_denkf.cli.main import main

ROOT = Path(__file__).parents[2]


def words(kitti, checkpoint, out, seed):
    drive = kitti / "sequences/b"
    given = ["odometry", drive / "image_2", "--calibration", drive / "calib.txt", "--checkpoint", checkpoint]
    return [str(word) for word in (*given, "--fps", "9.7", "--out", out, "--seed", seed, "--no-pictures")]


#: Runs a command that waits for a line after each row of its path.
SLOW = """
import sys
from torch_denkf.applications.car.odometry import paths
from torch_denkf.cli.main import main
row = paths._row
def waiting(belief):
    print("row", flush=True)
    sys.stdin.readline()
    return row(belief)
paths._row = waiting
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture
def slow(kitti, checkpoint, tmp_path):
    """A command in ``tmp_path / "both"`` that has begun to write its path."""
    command = [sys.executable, "-c", SLOW, *words(kitti, checkpoint, tmp_path / "both", 1)]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "row\n"
    yield process
    process.kill()
    process.wait()


def test_the_second_odometry_in_a_folder_is_refused(kitti, checkpoint, tmp_path, slow, capsys):
    both = tmp_path / "both"
    assert main(words(kitti, checkpoint, both, 2)) == 2
    assert f"cannot use {both}: another process is writing to it (process {slow.pid})" in capsys.readouterr().err
    slow.communicate("\n" * 100)
    assert slow.returncode == 0
    assert main(words(kitti, checkpoint, tmp_path / "alone", 1)) == 0
    for name in ("path.csv", "path_kitti.txt", "path_tum.txt"):
        assert (both / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    assert sorted(os.listdir(both)) == sorted(os.listdir(tmp_path / "alone"))
