"""Three small rendered drives, and a filter that ``denkf train`` made of them in a few updates, made once."""

import contextlib
import io
import shutil

import cv2
import pytest

from torch_denkf.applications.car import read_kitti_drive, write_drives
from torch_denkf.applications.car.odometry.training import Updates
from torch_denkf.cli.main import main
from torch_denkf.pretrained import from_pretrained

cv2.setNumThreads(1)
SIZE = (25, 75)
#: One training, as words of the command and as arguments of ``train_car_filter``.
WORDS = "--size 25 75 --seed 3 --sensor-updates 6 --filter-updates 4 --end-to-end-updates 3 --length 6"
OPTIONS = {"size": SIZE, "seed": 3, "updates": Updates(sensor=6, filter=4, end_to_end=3, length=6), "progress": False}


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    """KITTI's layout with drives a, b, c of 16 frames."""
    folder = tmp_path_factory.mktemp("kitti")
    write_drives(folder, ["a", "b", "c"], frames=16, size=SIZE)
    return folder


@pytest.fixture(scope="session")
def training(root, tmp_path_factory):
    """Returns the folder of a training, and what the command said."""
    folder, said = tmp_path_factory.mktemp("car"), io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["train", "--root", str(root), "--out", str(folder), *WORDS.split()]) == 0
    return folder, said.getvalue()


@pytest.fixture
def trained(training):
    """Returns the folder of the training, and its filter."""
    return training[0], from_pretrained(training[0])


@pytest.fixture
def checkpoint(training, tmp_path):
    """Returns a copy of the filter's folder, without what the training needs."""
    for name in ("config.json", "weights.safetensors"):
        shutil.copy(training[0] / name, tmp_path / name)
    return tmp_path


@pytest.fixture
def drive(root):
    """Drive b as images, with the mask."""
    return read_kitti_drive(root, "b", size=SIZE, colour=False, cache=None)
