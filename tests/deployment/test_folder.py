"""A model in a folder: killed at any call, a save leaves the old model or the new one."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.deployment.killed_saves import line, save
from torch_denkf.compilation.lock import locked
from torch_denkf.deployment.folder import load_folder

ROOT = Path(__file__).parents[2]
FILES = ["config.json", "weights.safetensors"]


def test_a_killed_save_leaves_the_old_model_or_the_new_one(tmp_path):
    command = [sys.executable, "-m", "tests.deployment.killed_saves", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    old, new = [2.0] * 2, [3.0] * 3
    there = [each["there"] for each in found]
    changes = there.index(new)
    assert there == [old] * changes + [new] * (len(there) - changes)
    assert 0 < changes < len(there) - 1, "killed before and after"
    assert [each["code"] for each in found] == [-signal.SIGKILL] * (len(found) - 1) + [0]
    assert all(each["later"] == FILES for each in found), "what a kill left goes with the next save"


def test_two_savers_at_a_time(tmp_path):
    with (
        locked(tmp_path, ".saving", "is saving to it"),
        pytest.raises(OSError, match=rf"cannot use {tmp_path}: another process is saving to it"),
    ):
        save(tmp_path, 2)


def test_white_space_of_a_description_does_not_count(tmp_path):
    save(tmp_path, 2)
    file = tmp_path / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text())))
    assert load_folder(tmp_path, {"line": line}).in_features == 2
