"""Results are written whole or not at all, also by killed processes and by two at a time."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torch_denkf.compilation.lock import locked
from torch_denkf.deployment.files import replacing, write_bytes, write_text

ROOT = Path(__file__).parents[2]


def start(code, *arguments):
    """Returns a process that says when it holds what it holds."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    return process


WRITES = """
import sys
from torch_denkf.deployment.files import replacing
with replacing(sys.argv[1]) as beside:
    beside.write_text("half")
    print("ready", flush=True)
    sys.stdin.read()
    beside.write_text("whole")
"""

LOCKS = """
import sys
from pathlib import Path
from torch_denkf.compilation.lock import locked
with locked(Path(sys.argv[1]), ".lock", "is writing to it"):
    print("ready", flush=True)
    sys.stdin.read()
"""


def test_failure_keeps_the_old_file(tmp_path):
    file = tmp_path / "new" / "table.csv"
    write_text(file, "earlier")
    for error in (ValueError, KeyboardInterrupt, OSError):
        with pytest.raises(error):
            fail_half_way(file, error)
    assert file.read_text() == "earlier"
    assert os.listdir(file.parent) == ["table.csv"]
    write_bytes(file, b"later")
    assert file.read_bytes() == b"later"
    assert file.stat().st_mode & 0o777 == 0o666 & ~_mask()


def fail_half_way(file, error):
    with replacing(file) as beside:
        assert (beside.parent.parent, beside.name) == (file.parent, file.name)
        beside.write_text("half")
        raise error


def _mask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_leftovers_of_killed_writers_are_removed(tmp_path):
    file = tmp_path / "result.json"
    write_text(file, "earlier")
    alive, killed = start(WRITES, file), start(WRITES, file)
    assert len(os.listdir(tmp_path)) == 3
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert file.read_text() == "earlier"
    (tmp_path / ".hidden.part").write_text("not ours")
    write_text(tmp_path / "other.json", "another result")
    assert len(os.listdir(tmp_path)) == 4  # both results, the living one's half, and the hidden file
    alive.communicate()
    assert file.read_text() == "whole"
    assert sorted(os.listdir(tmp_path)) == [".hidden.part", "other.json", "result.json"]


def test_links_stay_and_devices_are_written_to(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "last.pt").symlink_to(tmp_path / "elsewhere" / "last.pt")
    write_text(tmp_path / "last.pt", "new")
    assert (tmp_path / "last.pt").is_symlink()
    assert (tmp_path / "elsewhere" / "last.pt").read_text() == "new"
    write_text("/dev/null", "nothing")
    assert not Path("/dev/null").is_file()
    with pytest.raises(IsADirectoryError, match=r"cannot write .*elsewhere: Is a directory .*choose another"):
        write_text(tmp_path / "elsewhere", "text")


def test_a_folder_is_one_process_s_alone(tmp_path):
    holder = start(LOCKS, tmp_path)
    match = rf"cannot use .*{tmp_path.name}: another process is writing to it \(process {holder.pid}\); wait"
    with pytest.raises(OSError, match=match), locked(tmp_path, ".lock", "is writing to it"):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with locked(tmp_path, ".lock", "is writing to it"):
        assert os.listdir(tmp_path) == [".lock"]
    assert os.listdir(tmp_path) == []
