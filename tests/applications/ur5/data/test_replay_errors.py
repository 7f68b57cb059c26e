"""Raises for wrong options, folders and files with their names and with what to do."""

from functools import partial

import pytest

from tests.applications.ur5.data.ur5_demos import make_demo, ten_demos, write_folder
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.data.files import COMMAND, MANIFEST, read_manifest

open_dataset = partial(UR5ExperienceReplay, cache=None)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return ten_demos(tmp_path_factory)


def test_options_out_of_range(root):
    with pytest.raises(ValueError, match="offers single rows alone"):
        open_dataset(root, frames_only=True, slice_len=3)
    with pytest.raises(ValueError, match=r"slices have 7 rows, but 1 episodes are shorter: {'demo-000008': 6}"):
        open_dataset(root, split="all", slice_len=7, batch_size=14)
    short = open_dataset(root, split="all", slice_len=7, batch_size=14, strict_length=False)
    assert len(short.sample()) in (12, 13, 14)


def test_damaged_line_of_the_manifest(tmp_path):
    """A damaged line of the manifest raises; a collection skips it with a warning, and records that demo again."""
    write_folder(tmp_path, [make_demo(number, 8) for number in range(4)])
    lines = (tmp_path / MANIFEST).read_text().splitlines()
    (tmp_path / MANIFEST).write_text("\n".join([lines[0], '{"demo": 1, "fi', *lines[2:], ""]))
    with pytest.raises(ValueError, match=rf'{MANIFEST}:2 .*{{"demo": 1, "fi.*{COMMAND}'):
        open_dataset(tmp_path)
    with pytest.warns(UserWarning, match=rf"{MANIFEST}:2 is damaged .*; its demo is made again"):
        assert list(read_manifest(tmp_path, skip_damaged=True)) == [0, 2, 3]
