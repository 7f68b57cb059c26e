"""Compares the time of a step to the roofline bound: operations over peak rate, or bytes over bandwidth."""

from __future__ import annotations

from benchmarks.speed.machine import matrix_product, measure
from benchmarks.speed.ours import sequences
from benchmarks.speed.pairs import Row, interleave
from benchmarks.speed.workload import STEPS, make_filter, operations, traffic


def rows(seconds: float) -> list[Row]:
    out = []
    for batch, target, aim in ((1, 20, 12), (64, 4, 2.5)):
        filter = make_filter()
        product, flops = matrix_product()
        ours = sequences(batch)
        timings = interleave({**ours, "peak": product}, seconds=seconds)
        # The peak is measured in the same rounds, so that a slow machine is slow for both.
        peak = flops / (1e-6 * timings.micro("peak"))
        floor = max(operations(batch) / peak, traffic(filter, batch) / (1e9 * measure()["bandwidth_gb_s"]))
        note = f"{operations(batch) / 1e6:.2f} MFLOP per step at {peak / 1e9:.0f} GFLOP/s"
        for kind in ours:
            taken = timings.micro(kind, STEPS)
            name = f"{kind} sequence / floor, B={batch}"
            out.append(Row(name, taken / (1e6 * floor), target, aim, taken, 1e6 * floor, note))
    return out
