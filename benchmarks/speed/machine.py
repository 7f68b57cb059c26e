"""Measures matrix peak and memory bandwidth of one thread in the same run."""

from __future__ import annotations

import platform
import time

import torch

from benchmarks.common.arguments import processor


def matrix_product(size: int = 768):
    """Returns a product of two square float32 matrices, and the number of its floating-point operations."""
    left, right, out = torch.randn(size, size), torch.randn(size, size), torch.empty(size, size)
    return lambda: torch.mm(left, right, out=out), 2 * size**3


def best(call, repeats: int = 40) -> float:
    """Returns the least processor time of a call, in s."""
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        call()
        times.append(time.process_time() - begun)
    return min(times)


def measure() -> dict:
    """Returns peak in GFLOP/s (float32, one thread), bandwidth in GB/s (read and write of a copy), and versions.

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
