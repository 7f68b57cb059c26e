"""Half a library in inductor's cache: removed, said, and compiled again; whole ones and those being written stay."""

import logging
import os
import shutil

import pytest
import torch
from tensordict import TensorDict

from tests.conftest import COMPILED
from tests.filters.factories import has_compiler
from torch_denkf._lock import locked
from torch_denkf.filters import KalmanFilter
from torch_denkf.filters.inductor.libraries import clear_damaged_libraries, is_whole

ELF = torch.__path__[0] + "/lib/libtorch_python.so"


@pytest.fixture
def cache(tmp_path):
    """A copy of a small real library, and of its beginnings."""
    source = next(
        os.path.join(folder, name)
        for folder in (torch.__path__[0] + "/lib",)
        for name in sorted(os.listdir(folder), key=lambda name: os.path.getsize(os.path.join(folder, name)))
        if name.endswith(".so")
    )
    (tmp_path / "ab").mkdir()
    shutil.copy(source, tmp_path / "ab" / "cabwhole.so")
    size = os.path.getsize(source)
    for name, length in (("empty", 0), ("head", 40), ("half", size // 2), ("nearly", size - 1)):
        shutil.copy(source, tmp_path / "ab" / f"cab{name}.main.so")
        os.truncate(tmp_path / "ab" / f"cab{name}.main.so", length)
    (tmp_path / "ab" / "cabtext.so").write_text("x" * 200)
    return tmp_path


def test_half_libraries_go_and_whole_ones_stay(cache, caplog):
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


@pytest.mark.skipif(not has_compiler(), reason="torch.compile needs a C++ compiler")
def test_a_filter_compiles_beside_half_a_library(caplog):
    """Libraries of the tests' own cache that this filter was compiled to, cut as a killed linker leaves them."""

    def run():
        torch.compiler.reset()
        one = torch.eye(1)
        kf = KalmanFilter(one, one, one, one, mean=torch.zeros(1), cov=one).compile(chunk=1)
        return kf.sequence(TensorDict({"observation": torch.ones(3, 1)}, [3]))["belief", "mean"]

    started = {path: path.stat().st_mtime_ns for path in COMPILED.glob("*/*.so")}
    expected = run()
    made = [path for path in COMPILED.glob("*/*.so") if path not in started]
    assert expected.flatten().tolist() == pytest.approx([2 / 3, 7 / 8, 20 / 21])
    cut = made[:2]
    for path in cut:
        os.truncate(path, 30)
    with caplog.at_level(logging.WARNING, "torch_denkf"):
        assert torch.equal(run(), expected)
    assert [str(path) in caplog.text for path in cut] == [True] * len(cut)
