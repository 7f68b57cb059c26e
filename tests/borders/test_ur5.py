"""Damaged collections of UR5 demos: refused by file and line."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from tests.borders.test_constructors import refused
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.data.files import COMMAND, MANIFEST, read_manifest, write_demo, write_manifest

open_all = partial(UR5ExperienceReplay, cache=None, split="all", progress=False)


@pytest.fixture
def root(tmp_path):
    write_folder(tmp_path, [make_demo(number, 8) for number in range(4)])
    return tmp_path


def refuses(root, *words):
    refused(lambda: open_all(root), *words, COMMAND)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("key", ["state", "action"])
def test_numbers_that_are_not_finite(tmp_path, key, value):
    demo = make_demo(1, 8)
    values = getattr(demo, key).copy()
    values[3, 2] = value
    write_folder(tmp_path, [make_demo(0, 8), replace(demo, **{key: values})])
    refuses(tmp_path, "demo-000001.npz", f"'{key}'", "row 3", str(value))


LINES = {
    "cut": ('{"demo": 1, "fi', f"{MANIFEST}:2", '{"demo": 1, "fi'),
    "empty": ("", f"{MANIFEST}:2", "''"),
    "a number": ("17", f"{MANIFEST}:2", "no entry"),
    "another field": ('{"demo": 1, "seed": 3}', f"{MANIFEST}:2", "seed"),
    "negative": ({"demo": -1}, f"{MANIFEST}:2", "demo must be", "got -1"),
    "rows 0": ({"rows": 0}, f"{MANIFEST}:2", "rows must be", "got 0"),
    "rows a float": ({"rows": 8.5}, f"{MANIFEST}:2", "rows must be", "8.5"),
    "above": ({"file": "../demo-000001.npz"}, f"{MANIFEST}:2", "../demo-000001.npz"),
    "a zero byte": ({"file": "demo\0.npz"}, f"{MANIFEST}:2", "outside of its folder"),
    "twice": ({"demo": 0}, f"{MANIFEST}:2", "demo 0 is listed in another line"),
}


def damage(root, change):
    lines = (root / MANIFEST).read_text().splitlines()
    lines[1] = change if isinstance(change, str) else json.dumps(json.loads(lines[1]) | change)
    (root / MANIFEST).write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("case", LINES.values(), ids=LINES)
def test_damaged_lines(root, case):
    """They dropped their demo; collecting goes on without them and makes it again."""
    change, *words = case
    damage(root, change)
    refuses(root, *words)
    with pytest.warns(UserWarning, match=rf"{MANIFEST}:2 is damaged .*; its demo is made again"):
        assert list(read_manifest(root, skip_damaged=True)) == [0, 2, 3]


def test_a_last_line_that_is_being_written(root):
    text = (root / MANIFEST).read_text()
    (root / MANIFEST).write_text(text[:-20])
    assert [episode.demo for episode in open_all(root).episodes] == [0, 1, 2]


def test_the_same_line_twice_is_one_demo(root):
    entry = write_demo(root, make_demo(2, 8))
    write_manifest(root, [*read_manifest(root).values(), entry])
    assert len(open_all(root).episodes) == 4
