"""Worker processes end with the process that started them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

PROGRAM = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from torch_denkf.deployment.workers import follow_parent

if __name__ == "__main__":
    with ProcessPoolExecutor(2, get_context("spawn"), initializer=follow_parent) as pool:
        waiting = [pool.submit(time.sleep, 600) for _ in range(2)]
        print(*pool._processes, flush=True)
        time.sleep(600)
"""


def running(pid: int) -> bool:
    try:
        return "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()  # a zombie has no command line
    except OSError:
        return False


def test_workers_of_a_killed_parent_end(tmp_path):
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen([sys.executable, str(file)], stdout=subprocess.PIPE, text=True, env=environment) as run:
        workers = [int(pid) for pid in run.stdout.readline().split()]
        assert len(workers) == 2
        until = time.monotonic() + 60
        while not all(
            Path(f"/proc/{pid}/task").is_dir() and len(os.listdir(f"/proc/{pid}/task")) > 1 for pid in workers
        ):
            assert time.monotonic() < until  # the thread that watches has begun
            time.sleep(0.05)
        run.send_signal(signal.SIGKILL)
    until = time.monotonic() + 20
    while any(running(pid) for pid in workers):
        assert time.monotonic() < until
        time.sleep(0.05)
