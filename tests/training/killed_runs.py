"""Trains unbroken, and again with kills; imports once and forks, so that a run costs little more than its updates.

python -m tests.training.killed_runs FOLDER
"""

import os
import socket
import sys
import traceback
from functools import partial
from pathlib import Path

import torch

from tests.training.problem import make_trainer

# (place, how often it was passed); a run is killed at each of its points in turn, then it may end.
KILLS = {
    "first_sample": [("sample", 1)],
    "after_rows_that_no_checkpoint_knows": [("log", 3)],
    "later_validation": [("validate", 7)],
    "while_the_best_is_written": [("before replace", 1)],
    "after_a_checkpoint": [("after replace", 6)],
    "twice_in_the_last_stage": [("sample", 12), ("sample", 3)],
    "two_processes": [("sample", 8)],
}


def fork(work, environment):
    """Works in a new process; returns its number."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        os.environ.update(environment)
        work()
        status = 0
    except Exception:
        traceback.print_exc()
    finally:
        os._exit(status)


def in_processes(*works):
    """Works as ``torchrun`` starts processes; returns how the first one ended: 0, or minus the signal."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": str(len(works))}
    children = [fork(work, {**address, "RANK": str(rank)} if len(works) > 1 else {}) for rank, work in enumerate(works)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    return codes[0]


def train(out, kill=()):
    trainer = make_trainer(out, kill=kill, loggers=("csv", "tensorboard"))
    trainer.fit()
    torch.save(trainer.model.state_dict(), Path(out) / f"final_{trainer.processes.rank}.pt")


def run(out, kill=(), processes=1):
    """Trains; only the first process is killed, the others lose their partner and fail."""
    works = [partial(train, out, kill if rank == 0 else ()) for rank in range(processes)]
    return in_processes(*works)


def main(folder):
    torch.set_num_threads(1)
    assert run(folder / "unbroken") == 0
    assert run(folder / "unbroken_two", processes=2) == 0
    for name, kills in KILLS.items():
        processes = 2 if name == "two_processes" else 1
        for kill in kills:
            code = run(folder / name, kill, processes)
            assert code == -9, f"{name}: {kill} ended with {code}"
        assert run(folder / name, processes=processes) == 0, name


if __name__ == "__main__":
    main(Path(sys.argv[1]))
