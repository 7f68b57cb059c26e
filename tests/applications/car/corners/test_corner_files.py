"""Files of corners that are damaged, or hold another camera's, gyro's or clock's numbers: told of by the entry."""

import os
import warnings

import numpy as np
import pytest

from tests.borders.corners import BAD_ENTRIES, sound_entries
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


@pytest.mark.parametrize("what", BAD_ENTRIES)
def test_entries(tmp_path, what):
    name, change = BAD_ENTRIES[what]
    entries = sound_entries()
    changed = change(entries[name])
    entries = {key: value for key, value in {**entries, name: changed}.items() if value is not None}
    with pytest.raises((ValueError, KeyError), match=rf"drive.npz.*{name}"):
        read_corner_drive(written(tmp_path / "drive.npz", entries))


@pytest.mark.parametrize("rows", [0, 1, 9, 2.5, -3])
def test_rows(tmp_path, rows):
    with pytest.raises((ValueError, TypeError), match=r"rows must be .*drive.npz has 8"):
        read_corner_drive(written(tmp_path / "drive.npz", sound_entries()), rows)


@pytest.mark.parametrize("content", [b"", b"GIF89a", "cut", "an object"])
def test_files_that_hold_no_numbers(tmp_path, content):
    file = tmp_path / "drive.npz"
    written(file, {**sound_entries(), "b": np.array([{}], dtype=object)} if content == "an object" else sound_entries())
    if content != "an object":
        file.write_bytes(file.read_bytes()[:-30] if content == "cut" else content)
    with pytest.raises(ValueError, match=r"drive.npz is no npz file of numbers"):
        read_corner_drive(file)


@pytest.mark.parametrize("make", [lambda file: None, os.mkdir, os.mkfifo], ids=["nothing", "a folder", "a pipe"])
def test_no_file(tmp_path, make):
    make(tmp_path / "drive.npz")
    with pytest.raises(FileNotFoundError, match=r"no file .*drive.npz"):
        read_corner_drive(tmp_path / "drive.npz")


def test_stamps_in_nanoseconds(tmp_path):
    entries = sound_entries()
    file = written(tmp_path / "drive.npz", {**entries, "time_stamps": 1e9 * entries["time_stamps"]})
    with pytest.warns(UserWarning, match=r"'time_stamps' has times up to 1.3e\+18 s, .* write them in s"):
        read_corner_drive(file)


def test_no_drives():
    with pytest.raises(ValueError, match="drives is empty"):
        corner_replay({})
