"""Damaged collections of UR5 demos: the error names file and line."""

from functools import partial

import pytest

from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from tests.borders.test_constructors import message_of
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.data.files import COMMAND, MANIFEST, read_manifest, write_demo, write_manifest

open_all = partial(UR5ExperienceReplay, cache=None, split="all", progress=False)


@pytest.fixture
def root(tmp_path):
    write_folder(tmp_path, [make_demo(number, 8) for number in range(4)])
    return tmp_path


def test_damaged_line_of_the_manifest(root):
    """A damaged line of the manifest raises; a collection skips it with a warning, and records that demo again."""
    lines = (root / MANIFEST).read_text().splitlines()
    (root / MANIFEST).write_text("\n".join([lines[0], '{"demo": 1, "fi', *lines[2:], ""]))
    message_of(lambda: open_all(root), f"{MANIFEST}:2", '{"demo": 1, "fi', COMMAND)
    with pytest.warns(UserWarning, match=rf"{MANIFEST}:2 is damaged .*; its demo is made again"):
        assert list(read_manifest(root, skip_damaged=True)) == [0, 2, 3]


def test_incomplete_last_line_is_skipped(root):
    text = (root / MANIFEST).read_text()
    (root / MANIFEST).write_text(text[:-20])
    assert [episode.demo for episode in open_all(root).episodes] == [0, 1, 2]


def test_duplicate_line_is_one_demo(root):
    entry = write_demo(root, make_demo(2, 8))
    write_manifest(root, [*read_manifest(root).values(), entry])
    assert len(open_all(root).episodes) == 4
