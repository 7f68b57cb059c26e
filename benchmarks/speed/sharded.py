"""How long an analysis takes whose state is spread over the processes that ``torchrun`` starts.

    python -m torch.distributed.run --nproc_per_node=2 -m benchmarks.speed.sharded

Each line: seconds of one analysis, the least of three, and the memory of a process at its peak.
"""

from __future__ import annotations

import csv
import resource
import time
from pathlib import Path

import torch
import torch.distributed as dist

from torch_denkf.functional.kernels.sharded import analyse_sharded

SIZES, MEMBERS, EVERY = (10**5, 10**6, 10**7), 32, 10  # components of the state; every tenth is observed
RESULTS = Path(__file__).parent / "results" / "sharded.csv"


def seconds(size: int) -> float:
    """Of one analysis of ``size`` components, on this process's share."""
    rank, world = dist.get_rank(), dist.get_world_size()
    torch.manual_seed(rank)
    forecast = torch.randn(MEMBERS, size // world)
    predicted = forecast[:, ::EVERY].contiguous()
    reading, noise = torch.randn(predicted.shape[-1]), torch.ones(predicted.shape[-1])
    times = []
    for _ in range(3):
        dist.barrier()
        begin = time.perf_counter()
        out = analyse_sharded(forecast, predicted, reading, noise, scheme="etkf")
        dist.barrier()
        times.append(time.perf_counter() - begin)
        if not out.ensemble.isfinite().all():
            raise FloatingPointError(f"the analysis of {size} components is not finite")
    return min(times)


def main() -> None:
    dist.init_process_group("gloo")
    torch.set_num_threads(1)
    world, rows = dist.get_world_size(), []
    for size in SIZES:
        taken = seconds(size)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        rows.append([size, MEMBERS, world, f"{taken:.4f}", f"{peak:.2f}"])
        if dist.get_rank() == 0:
            print(f"{size:>9} components, {world} processes: {taken:.3f} s, {peak:.1f} GiB a process", flush=True)
    if dist.get_rank() == 0:
        kept = []
        if RESULTS.exists():
            with RESULTS.open(newline="") as file:
                kept = [row for row in list(csv.reader(file))[1:] if row[2] != str(world)]
        with RESULTS.open("w", newline="") as file:
            head = ["components", "members", "processes", "seconds", "gib_a_process"]
            csv.writer(file).writerows([head, *sorted([*kept, *rows], key=lambda row: (int(row[0]), int(row[2])))])
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
