"""Measures what the machine can do, measured in the same run: matrix peak and memory bandwidth of one thread."""

from __future__ import annotations

import platform
import subprocess
import sys
import time
from pathlib import Path

import torch

from benchmarks.common.arguments import processor


def matrix_product(size: int = 768):
    """A product of two square float32 matrices, and the number of its floating-point operations."""
    left, right, out = torch.randn(size, size), torch.randn(size, size), torch.empty(size, size)
    return lambda: torch.mm(left, right, out=out), 2 * size**3


def best(call, repeats: int = 40) -> float:
    """The least processor time of a call, in s."""
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        call()
        times.append(time.process_time() - begun)
    return min(times)


def measure() -> dict:
    """Peak in GFLOP/s (float32, one thread), bandwidth in GB/s (read and write of a copy), and what was run on.

    Both are the best of 40, in processor time.
    """
    torch.set_num_threads(1)
    product, operations = matrix_product()
    source = torch.randn(2**24)
    target = torch.empty_like(source)
    return {
        "processor": processor(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "peak_gflops": operations / best(product) / 1e9,
        "bandwidth_gb_s": 2 * source.nbytes / best(lambda: target.copy_(source)) / 1e9,
    }


PEAK = """
import torch
torch.set_num_threads(1)
def kib(name):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name))
{prepare}
before = kib("VmRSS")
{inputs}
open("/proc/self/clear_refs", "w").write("5")  # the peak starts anew: to make the inputs took more
{act}
print(1024 * (kib("VmHWM") - before))
"""


def resident_peak(prepare: str, act: str, inputs: str = "") -> float:
    """Bytes that lines of Python take at most, in a process of their own, started in the repository's root.

    Args:
        prepare: what is there before, and does not count.
        act: what is measured.
        inputs: what it starts from, which counts as long as it is held.
    """
    script = PEAK.format(prepare=prepare, act=act, inputs=inputs)
    command = [sys.executable, "-c", script]
    root = Path(__file__).parents[2]
    return float(subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=600, check=True).stdout)
