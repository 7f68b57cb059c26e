"""Every test starts from the same seed; ``float64`` makes double the default type of what it builds.

``pytest tests/filters/test_kalman.py --compiled`` puts all filters through ``torch.compile``.
"""

import os
import subprocess
import tempfile
from pathlib import Path

import pytest
import torch

from tests.filters.factories import has_compiler
from torch_denkf.compilation.libraries import clear_damaged_libraries
from torch_denkf.filters import Filter

# A cache of the tests' own, kept from one run to the next: what a killed run left unfinished harms nobody else.
COMPILED = Path(os.environ.get("TORCHINDUCTOR_CACHE_DIR") or f"{tempfile.gettempdir()}/torch_denkf_tests_{os.getuid()}")
os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(COMPILED)


def pytest_sessionstart():
    clear_damaged_libraries(COMPILED)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.fixture
def small_disk(tmp_path):
    """Mounts disks of a given size, such as "600k"; skips where that takes rights that the tests do not have."""
    mounted = []

    def mount(size):
        folder = tmp_path / f"disk{len(mounted)}"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError:
            pytest.skip("there is no command mount")
        if done.returncode:
            pytest.skip(f"only root may mount a small disk: {done.stderr.strip()}")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run(["umount", "--lazy", str(folder)], check=False)


@pytest.fixture
def float64():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield torch.float64
    torch.set_default_dtype(before)


def pytest_addoption(parser):
    parser.addoption(
        "--compiled", action="store_true", help="filters compile themselves: oracles must hold all the same"
    )


@pytest.fixture(autouse=True)
def compiled(request, monkeypatch):
    if request.config.getoption("--compiled"):
        if not has_compiler():
            pytest.skip("inductor finds no C++ compiler: apt install g++")
        plain = Filter.__init__

        def compile_too(self, *args, **kwargs):
            plain(self, *args, **kwargs)
            self.compile(chunk=4)

        monkeypatch.setattr(Filter, "__init__", compile_too)
