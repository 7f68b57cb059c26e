"""Times filter and smoother on an attitude log of 13,500 rows at 100 Hz, from a cold start.

Cold is a new process with an empty cache of torch's compiler, eager and compiled in steps (``chunk=1``).

python -m benchmarks.speed.log_of_attitude eager     # one way in this process, in seconds
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time

import torch

from benchmarks.speed.one_row import attitude
from benchmarks.speed.pairs import Row
from torch_denkf.smoothers import RTSSmoother

ROWS, WANTED_S = 13_500, 30.0
WAYS = ("eager", "compiled")


def filter_and_smooth(way: str) -> dict[str, float]:
    """Returns the seconds of filter and smoother on a log, including the first compilation."""
    begun = time.perf_counter(), time.process_time()
    filter, row = attitude()
    log = torch.stack([row] * ROWS, 1)
    smoother = RTSSmoother(filter.compile(chunk=1) if way == "compiled" else filter)
    with torch.no_grad():
        out = smoother(log)
    assert out["smoothed", "mean"].isfinite().all()
    return {"wall": time.perf_counter() - begun[0], "processor": time.process_time() - begun[1]}


def rows(seconds: float) -> list[Row]:
    """Returns rows of the table."""
    found = []
    for way in WAYS:
        with tempfile.TemporaryDirectory() as cache:
            command = [sys.executable, "-m", "benchmarks.speed.log_of_attitude", way]
            env = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache}
            run = json.loads(subprocess.run(command, env=env, check=True, capture_output=True, text=True).stdout)
        note = f"seconds, no ratio; processor time {run['processor']:.1f} s, compilers aside"
        name = f"log of 13,500 rows, attitude, filter and smoother, {way}, empty cache, s"
        found.append(Row(name, run["wall"], target=WANTED_S, note=note))
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(filter_and_smooth(sys.argv[1])))
