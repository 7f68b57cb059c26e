"""Runs a function as a GPU would."""

import pytest

from tests.waits import NothingWaits
from torch_denkf.functional.kernels import small_system


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Returns a function that runs another as a GPU would, and raises where that waits."""

    def run(function, *args, **kwargs):
        with monkeypatch.context() as patch, NothingWaits():
            patch.setattr(small_system, "GPUS", ("cuda", "cpu"))
            return function(*args, **kwargs)

    return run
