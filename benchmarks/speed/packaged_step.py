"""Compares a packaged step (AOTInductor) with the same eager step at B = 1, and measures its latency."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import torch

from benchmarks.speed.ours import tensordict_loop
from benchmarks.speed.pairs import Row, interleave
from benchmarks.speed.workload import make_filter, make_frames, start
from torch_denkf.deployment import export_step, load_step


def rows(seconds: float) -> list[Row]:
    filter = make_filter()
    frame = make_frames(1, 1)[0, 0].set(("belief", "ensemble"), start(filter, 1)[0])
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        package = export_step(filter, frame, Path(folder) / "step.pt2")
        written, step = time.perf_counter() - begun, load_step(package)
        entries = {"sensor.ensemble": frame.get(("sensor", "ensemble"))}
        entries["belief.ensemble"] = frame.get(("belief", "ensemble"))

        def packaged() -> None:
            with torch.inference_mode():
                out = step(entries)
            entries["belief.ensemble"] = out["belief.ensemble"]

        timings = interleave({"packaged": packaged, "eager": tensordict_loop(filter, 1)}, seconds=seconds)
        latencies = []
        for _ in range(5000):
            begun = time.perf_counter()
            packaged()
            latencies.append(1e3 * (time.perf_counter() - begun))
    latencies.sort()
    p50, p99 = (latencies[int(q * len(latencies))] for q in (0.5, 0.99))
    note = f"wall-clock latency of 5,000 steps: p50 {p50:.3f} ms, p99 {p99:.3f} ms, max {latencies[-1]:.2f} ms"
    ratio = timings.row("packaged step / eager step, B=1", "packaged", "eager", target=0.5, note=note)
    return [ratio, Row("package of a step, written, s", written, target=30.0, note="seconds, no ratio")]
