"""Trains in two processes for test_distributed; leaves the first gradient and the last parameters of each.

python -m tests.training.two_processes FOLDER
"""

import sys
from functools import partial
from pathlib import Path

import torch

from tests.training.killed_runs import in_processes
from tests.training.problem import make_trainer


def train(out):
    # End to end is not clipped: the gradient after a step is that before.
    trainer = make_trainer(out, noise_in_batch=True, stages=("end_to_end",), updates=3)
    trainer.model.unused = torch.nn.Parameter(torch.ones(1))
    rank, gradients = trainer.processes.rank, []

    def keep_first():
        if not gradients:
            gradients.append([None if p.grad is None else p.grad.clone() for p in trainer.model.parameters()])

    trainer.register_op("post_optim", keep_first)
    result = trainer.fit()
    lonely = torch.nn.Parameter(torch.zeros(2))
    lonely.grad = torch.tensor([3.0, -1.0]) if rank == 1 else None
    content = {"mean": trainer.processes.average_([lonely], torch.tensor([float(rank)])), "lonely": lonely.grad}
    content |= {"gradient": gradients[0], "model": trainer.model.state_dict(), "result": result}
    torch.save(content, out / f"rank_{rank}.pt")


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    work = partial(train, Path(sys.argv[1]))
    sys.exit(in_processes(work, work))
