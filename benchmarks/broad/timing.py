"""Times a trial in plain PyTorch, and a step out of its package: ``python -m benchmarks.broad.timing``."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.broad.task import simulated_trial
from benchmarks.common.arguments import made_by, parse
from torch_denkf.applications.imu import imu_rows, orientations
from torch_denkf.deployment import export_step, load_step
from torch_denkf.pretrained import from_pretrained


@dataclass(frozen=True)
class Timing:
    """Times the inertial sensor's filter on a simulated log."""

    readings: int = 55_000  # at 286 Hz
    package: bool = True  # time the packaged step, too: needs a C++ compiler, and minutes
    smoke: bool = False  # a second of readings, and no package


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the times."""
    options = parse(Timing, arguments)
    model, rate = from_pretrained("imu"), 286.0
    trial = simulated_trial(1.0 if options.smoke else options.readings / rate, rate)
    log = [value.float() for value in (trial.gyro, trial.acceleration, trial.magnetometer)]
    began = time.process_time()
    orientations(model, *log, rate=rate)  # type: ignore[arg-type]
    print(f"{len(log[0])} readings, 9 axes, eager: {time.process_time() - began:.1f} s of processor time")
    if options.package and not options.smoke:
        model = model.double()  # as denkf orient runs it
        rows = imu_rows(model.settings, *(value.double() for value in log), rate=rate)[:1000]  # type: ignore[arg-type]
        with tempfile.TemporaryDirectory() as folder:
            step = load_step(export_step(model, rows[0].clone(), Path(folder) / "imu.pt2"))
        with torch.inference_mode():
            entries = [
                {name: row[tuple(name.split("."))] for name in step.inputs if name not in step.carry} for row in rows
            ]
            first = model.initialise(rows[0].clone())
            carry = {name: first[tuple(name.split("."))] for name in step.carry}
            seconds = []
            for entry in entries * 3:
                begun = time.perf_counter()
                out = step({**entry, **carry})
                seconds.append(time.perf_counter() - begun)
                carry = {name: out[name] for name in step.carry}
        middle = sorted(seconds)[len(seconds) // 2]
        print(f"a packaged step: {1e3 * middle:.3f} ms, median; fastest {1e3 * min(seconds):.3f} ms")
    print("\n".join(made_by("broad.timing")))


if __name__ == "__main__":
    main()
