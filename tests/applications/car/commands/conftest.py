"""Rendered drives and a small untrained filter in a folder."""

import pytest
import torch

from torch_denkf.applications.car import write_drives
from torch_denkf.applications.car.odometry.filter import car_filter
from torch_denkf.pretrained import save_pretrained


@pytest.fixture(scope="session")
def kitti(tmp_path_factory):
    """KITTI's layout with drives a, b, c of 12 frames."""
    folder = tmp_path_factory.mktemp("kitti")
    write_drives(folder, ["a", "b", "c"], frames=12, size=(25, 75))
    return folder


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory):
    torch.manual_seed(0)
    return save_pretrained(car_filter(ensemble_size=8, size=(25, 75)), tmp_path_factory.mktemp("car"))
