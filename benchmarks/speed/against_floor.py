"""A step over a sequence against what the machine needs at least: operations over peak, or bytes over bandwidth."""

from __future__ import annotations

from benchmarks.speed.machine import matrix_product, measure
from benchmarks.speed.ours import sequence
from benchmarks.speed.pairs import Row, interleave
from benchmarks.speed.workload import STEPS, make_filter, operations, traffic


def rows(seconds: float) -> list[Row]:
    out = []
    for batch, target, aim in ((1, 20, 12), (64, 4, 2.5)):
        filter = make_filter()
        product, flops = matrix_product()
        timings = interleave({"ours": sequence(filter, batch), "peak": product}, seconds=seconds)
        # The peak of the same rounds, so that a machine that is slow for now is slow for both.
        peak = flops / min(timings.rounds["peak"])
        floor = max(operations(batch) / peak, traffic(filter, batch) / (1e9 * measure()["bandwidth_gb_s"]))
        ours = timings.micro("ours", STEPS)
        out.append(
            Row(
                f"sequence / floor, B={batch}",
                ours / (1e6 * floor),
                target,
                aim,
                ours,
                1e6 * floor,
                f"{operations(batch) / 1e6:.2f} MFLOP a step at {peak / 1e9:.0f} GFLOP/s",
            )
        )
    return out
