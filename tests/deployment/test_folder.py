"""A model in a folder: killed at any call, a save leaves the old model or the new one."""

import json
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from torch import nn

from tests.deployment.killed_saves import line, save
from torch_denkf.deployment import folder as module
from torch_denkf.deployment.folder import load_folder, save_folder

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


def test_two_savers_at_a_time(tmp_path, monkeypatch):
    """The second is told to wait, and does not mix its weights into the first one's folder."""
    inside, go_on = threading.Event(), threading.Event()
    write = module.write_text

    def slowly(*args):
        inside.set()
        go_on.wait()
        write(*args)

    monkeypatch.setattr(module, "write_text", slowly)
    first = threading.Thread(target=save, args=(tmp_path, 3))
    first.start()
    inside.wait()
    with pytest.raises(OSError, match=rf"cannot use {tmp_path}: another process is saving to it"):
        save_folder(nn.Linear(2, 1), tmp_path, builder="line", settings={"size": 2})
    go_on.set()
    first.join()
    assert load_folder(tmp_path, {"line": line}).in_features == 3


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_description_with_a_flipped_bit_is_told_of(tmp_path, share):
    """Each bit of it counts, of numbers, names and the record alike; white space does not."""
    save(tmp_path, 2)
    file = tmp_path / "config.json"
    text = file.read_text()
    numbers = [place for place, letter in enumerate(text) if letter.isdigit() or letter == "."]
    place = numbers[int(share * len(numbers))]
    flipped = text[:place] + chr(ord(text[place]) ^ 1) + text[place + 1 :]
    file.write_text(flipped)
    with pytest.raises(
        ValueError, match=r"config\.json (is damaged, or was changed by hand|is not JSON|does not describe)"
    ):
        load_folder(tmp_path, {"line": line})
    file.write_text(json.dumps(json.loads(text)))
    assert load_folder(tmp_path, {"line": line}).in_features == 2


@pytest.mark.parametrize(
    "change",
    [
        lambda config: config["settings"].update(size=3),
        lambda config: config["training"].update(seed=1),
        lambda config: config["versions"].update(torch="1.0"),
        lambda config: config.update(note="better"),
        lambda config: config.pop("versions"),
        lambda config: config.pop("checksum"),
        lambda config: config.update(checksum=3),
    ],
)
def test_a_description_that_was_changed_is_told_of(tmp_path, change):
    save(tmp_path, 2)
    config = json.loads((tmp_path / "config.json").read_text())
    change(config)
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"config\.json is damaged, or was changed by hand"):
        load_folder(tmp_path, {"line": line})
