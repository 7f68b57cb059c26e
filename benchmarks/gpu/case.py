"""One measurement: the call to time, the way to run it, and its result."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

import torch

#: Ways to run a filter, and the options of ``Filter.compile`` for each.
WAYS: dict[str, dict[str, Any]] = {
    "eager": {"chunk": 0},
    "graph": {"mode": "graph"},
    "compiled": {"mode": "graph", "backend": "inductor"},
}


@dataclass
class Case:
    """A call to time, which is made just before it is timed.

    Attributes:
        name: of the table's row.
        make: returns the call; takes no arguments.
        way: eager, graph, compiled, or a peer's name.
        batch: filters in a batch.
        steps: in one call.
        gradients: whether the call differentiates, too.
        dims: of the state.
    """

    name: str
    make: Callable[[], Callable[[], object]]
    way: str = "eager"
    batch: int = 1
    steps: int = 1
    gradients: bool = False
    dims: int = 5


@dataclass
class Found:
    """A row of the result; if ``ms`` is ``None``, ``note`` has the reason."""

    part: str
    name: str
    way: str
    batch: int
    steps: int
    gradients: bool
    dims: int
    ms: float | None = None
    first_s: float | None = None
    note: str = ""
    more: dict[str, float] = field(default_factory=dict)

    @property
    def rate(self) -> float | None:
        """Returns steps of one filter in a second."""
        return None if self.ms is None else 1e3 * self.batch * self.steps / self.ms

    def as_dict(self) -> dict[str, Any]:
        """Returns the fields, and the rate."""
        return {**asdict(self), "steps_per_s": self.rate}


def wait(device: str) -> None:
    """Waits for launched kernels."""
    if device == "cuda":
        torch.cuda.synchronize()


@contextmanager
def only_this(device: str) -> Iterator[None]:
    """Frees a case's memory before the next one."""
    try:
        yield
    finally:
        if device == "cuda":
            torch.cuda.empty_cache()


def measure(part: str, case: Case, device: str, seconds: float) -> Found:
    """Times a case for about so many seconds; an error becomes the row's note."""
    found = Found(part, case.name, case.way, case.batch, case.steps, case.gradients, case.dims)
    try:
        with only_this(device):
            call = case.make()
            began = time.perf_counter()
            call(), wait(device)
            found.first_s = time.perf_counter() - began
            times: list[float] = []
            for _ in range(2):
                call()
            wait(device)
            until = time.perf_counter() + seconds
            while len(times) < 3 or (time.perf_counter() < until and len(times) < 200):
                began = time.perf_counter()
                call(), wait(device)
                times.append(1e3 * (time.perf_counter() - began))
            found.ms = median(times)
            del call
    except Exception as error:
        found.note = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
    return found
