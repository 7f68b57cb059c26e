"""Truncated libraries in inductor's cache are removed with a message and compiled again; others are kept."""

import contextlib
import io
import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.conftest import COMPILED
from tests.filters.factories import has_compiler
from torch_denkf.compilation.libraries import clear_damaged_libraries, is_whole
from torch_denkf.compilation.lock import locked

ROOT = Path(__file__).parents[2]


@pytest.fixture
def cache(tmp_path):
    """Returns the smallest library of torch, and truncated copies of it."""
    source = min(Path(torch.__file__).parent.glob("lib/*.so"), key=os.path.getsize)
    (tmp_path / "ab").mkdir()
    shutil.copy(source, tmp_path / "ab" / "cabwhole.so")
    size = os.path.getsize(source)
    for name, length in (
        ("empty", 0),
        ("head", 40),
        ("half", size // 2),
        ("nearly", size - 64),
    ):  # the last bytes may be padding
        shutil.copy(source, tmp_path / "ab" / f"cab{name}.main.so")
        os.truncate(tmp_path / "ab" / f"cab{name}.main.so", length)
    (tmp_path / "ab" / "cabtext.so").write_text("x" * 200)
    return tmp_path


def test_truncated_libraries_are_removed_and_whole_ones_kept(cache, caplog):
    assert is_whole(cache / "ab" / "cabwhole.so")
    with caplog.at_level(logging.WARNING, "torch_denkf"), locked(cache / "locks", "cabhead.lock", "compiles"):
        removed = clear_damaged_libraries(cache)
    assert sorted(path.name for path in removed) == [
        "cabempty.main.so",
        "cabhalf.main.so",
        "cabnearly.main.so",
        "cabtext.so",
    ]
    assert sorted(path.name for path in (cache / "ab").iterdir()) == ["cabhead.main.so", "cabwhole.so"]
    assert len(caplog.records) == 4
    assert "it is compiled again" in caplog.text
    assert [path.name for path in clear_damaged_libraries(cache)] == ["cabhead.main.so"]
    assert clear_damaged_libraries(cache) == []


STEP = """
import logging
import torch
from tensordict import TensorDict
from torch_denkf.filters import KalmanFilter

def loaded():
    return {line.split()[-1] for line in open("/proc/self/maps") if line.rstrip().endswith(".main.so")}

logging.basicConfig()
before = loaded()
one = torch.eye(1)
kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one).compile()
out = kf.step(kf.initialise(TensorDict({"observation": torch.ones(5, 1)}, [5])))
print(out["belief", "mean"].flatten().tolist())
print(*sorted(loaded() - before))
"""


needs_compiler = pytest.mark.skipif(not has_compiler(), reason="torch.compile needs a C++ compiler")


@needs_compiler
@pytest.mark.slow
def test_a_compilation_that_was_killed_is_done_again():
    """A truncated library, as a killed linker leaves it, is compiled again."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(STEP, {})
    mean, libraries = said.getvalue().splitlines()
    assert json.loads(mean) == pytest.approx([2 / 3] * 5)
    library = Path(libraries.split()[0])
    assert library.is_relative_to(COMPILED)
    library.unlink()  # a process that has loaded it keeps it
    library.write_bytes(b"\x7fELF" + bytes(30))
    done = subprocess.run([sys.executable, "-c", STEP], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[0] == mean
    assert f"inductor's cache held half a library, {library}: it is compiled again" in done.stderr
    assert is_whole(library)
