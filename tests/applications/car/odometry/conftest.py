"""Three small rendered drives and a filter that was trained on them for a few updates, made once."""

import shutil

import cv2
import pytest
import torch

from torch_denkf.applications.car import read_kitti_drive, write_drives
from torch_denkf.applications.car.odometry.training import Updates, train_car_filter

cv2.setNumThreads(1)
SIZE = (25, 75)
FEW = Updates(sensor=6, filter=4, end_to_end=3, length=6)
OPTIONS = {"size": SIZE, "updates": FEW, "seed": 3, "progress": False}


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    """KITTI's layout with drives a, b, c of 16 frames."""
    folder = tmp_path_factory.mktemp("kitti")
    write_drives(folder, ["a", "b", "c"], frames=16, size=SIZE)
    return folder


@pytest.fixture(scope="session")
def trained(root, tmp_path_factory):
    """The folder of a training, with the filter as it came out."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("car")
    return folder, train_car_filter(folder, root=root, command="denkf train", **OPTIONS)


@pytest.fixture
def checkpoint(trained, tmp_path):
    """A copy of the filter's folder, without what the training needs."""
    for name in ("config.json", "weights.safetensors"):
        shutil.copy(trained[0] / name, tmp_path / name)
    return tmp_path


@pytest.fixture
def drive(root):
    """Drive b as images, with the mask."""
    return read_kitti_drive(root, "b", size=SIZE, colour=False, cache=None)
