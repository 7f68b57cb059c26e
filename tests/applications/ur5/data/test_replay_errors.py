"""Raises for wrong options, folders and files with their names and with what to do."""

import os
from functools import partial

import pytest

from tests.applications.ur5.data.ur5_demos import make_demo, ten_demos, write_folder
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.data.files import COMMAND

open_dataset = partial(UR5ExperienceReplay, cache=None)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return ten_demos(tmp_path_factory)


def test_options_out_of_range(root):
    with pytest.raises(ValueError, match="'validation', 'test' or 'all', got 'val'"):
        open_dataset(root, split="val")
    with pytest.raises(ValueError, match="offers single rows alone"):
        open_dataset(root, frames_only=True, slice_len=3)
    with pytest.raises(ValueError, match=r"\(13, 16\) is larger than the demos' \(12, 16\)"):
        open_dataset(root, size=(13, 16))
    with pytest.raises(ValueError, match="must be positive"):
        open_dataset(root, size=(0, 16))
    with pytest.raises(ValueError, match=r"slices have 7 rows, but 1 episodes are shorter: {'demo-000008': 6}"):
        open_dataset(root, split="all", slice_len=7, batch_size=14)
    short = open_dataset(root, split="all", slice_len=7, batch_size=14, strict_length=False)
    assert len(short.sample()) in (12, 13, 14)


def cut(file):
    file.write_bytes(file.read_bytes()[:-100])


def change(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


@pytest.mark.parametrize(("damage", "error"), [(cut, ValueError), (change, ValueError), (os.remove, FileNotFoundError)])
def test_damaged_files_are_named(tmp_path, damage, error):
    write_folder(tmp_path, [make_demo(number, 8) for number in range(3)])
    damage(tmp_path / "demo-000002.npz")
    with pytest.raises(error, match=f"{tmp_path / 'demo-000002.npz'}.*{COMMAND}"):
        open_dataset(tmp_path)
