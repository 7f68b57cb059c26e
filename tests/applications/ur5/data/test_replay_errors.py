"""What is wrong with options, folders and files is said with their names and with what to do."""

import hashlib
import json
import os
import time
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import numpy as np
import pytest

from tests.applications.ur5.data.ur5_demos import make_demo, ten_demos, write_folder
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.data import files
from torch_denkf.applications.ur5.data.files import COMMAND, MANIFEST, read_manifest, write_manifest

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


def test_a_cut_line_of_the_manifest_counts_as_not_written(root, tmp_path):
    write_folder(tmp_path, [make_demo(number, 8) for number in range(3)])
    text = (tmp_path / MANIFEST).read_text()
    (tmp_path / MANIFEST).write_text(text[:-30])
    assert list(read_manifest(tmp_path)) == [0, 1]
    assert [json.loads(line)["demo"] for line in text.splitlines()] == [0, 1, 2]
    assert [e.demo for e in open_dataset(tmp_path, split="all").episodes] == [0, 1]


def list_again(root, file):
    """The manifest as one who made the file would have written it."""
    entries = list(read_manifest(root).values())
    sha256 = hashlib.sha256((root / file).read_bytes()).hexdigest()
    write_manifest(root, [replace(entry, sha256=sha256) if entry.file == file else entry for entry in entries])


def test_bombs_are_refused_by_their_headers(tmp_path):
    """Files of a megabyte that would become gigabytes: nothing of them is unpacked."""
    write_folder(tmp_path, [make_demo(0, 8)])
    file = tmp_path / "demo-000000.npz"
    sound = dict(np.load(file))
    frames = sound["pixels"].shape[0]
    bombs = {
        "pixels": (
            np.broadcast_to(np.uint8(0), (frames + 900, 3, 500, 500)),
            rf"'pixels' .* \({frames}, 3, None, None\)",
        ),
        "state": (
            np.broadcast_to(np.float32(0), (3_000_000, 10)),
            r"'state' of shape \(3000000, 10\), .* says \(8, 10\)",
        ),
        "more": (np.broadcast_to(np.uint8(0), 10**8), r"it holds \[.*'more'"),
        "pickle": (np.array([{}], dtype=object), r"it holds \[.*'pickle'"),
    }
    for name, (array, match) in bombs.items():
        np.savez_compressed(file, **{**sound, name: array})
        list_again(tmp_path, file.name)
        start = time.perf_counter()
        with pytest.raises(ValueError, match=match):
            open_dataset(tmp_path)
        assert time.perf_counter() - start < 0.5, name
    huge = {**sound, "pixels": np.broadcast_to(np.uint8(0), (frames, 3, 4000, 4000))}
    np.savez_compressed(file, **huge)
    list_again(tmp_path, file.name)
    with patch.object(files, "MOST_BYTES", 10**8), pytest.raises(ValueError, match=r"announces \d+ bytes, more than"):
        open_dataset(tmp_path)
    with (
        patch.object(files, "MOST_BYTES", 1000),
        pytest.raises(ValueError, match=r"more than a demo can have \(1000\)"),
    ):
        open_dataset(tmp_path)


@pytest.mark.parametrize("place", ["../demo-000000.npz", "{parent}/demo-000000.npz", "", "..", "a/../demo-000000.npz"])
def test_demos_outside_of_the_folder_are_refused(tmp_path, place):
    root = tmp_path / "demos"
    root.mkdir()
    write_folder(root, [make_demo(0, 8)])
    (tmp_path / "demo-000000.npz").write_bytes((root / "demo-000000.npz").read_bytes())
    (entry,) = read_manifest(root).values()
    write_manifest(root, [replace(entry, file=place.format(parent=tmp_path))])
    with pytest.raises(ValueError, match=r"demos.jsonl:1 is damaged \(it names a file outside of its folder"):
        open_dataset(root)
