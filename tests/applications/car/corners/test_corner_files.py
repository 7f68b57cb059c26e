"""Files of corners. Damaged ones are cases of tests/borders/corners.py."""

import warnings

import numpy as np
import pytest

from tests.borders.corners import sound_entries
from torch_denkf.applications.car.corners.drive import corner_replay, read_corner_drive


def written(file, entries):
    np.savez(file, **entries)
    return file


def test_a_sound_file(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rows, camera = read_corner_drive(written(tmp_path / "drive.npz", sound_entries()))
    assert rows["seen"].sum(-1).tolist() == [0, *[6] * 7]
    assert camera.focal == 700.0
    assert len(read_corner_drive(str(tmp_path / "drive.npz"), 3)[0]) == 3


def test_stamps_in_nanoseconds(tmp_path):
    entries = sound_entries()
    file = written(tmp_path / "drive.npz", {**entries, "time_stamps": 1e9 * entries["time_stamps"]})
    with pytest.warns(UserWarning, match=r"'time_stamps' has times up to 1.3e\+18 s, .* write them in s"):
        read_corner_drive(file)


def test_no_drives():
    with pytest.raises(ValueError, match="drives is empty"):
        corner_replay({})
