"""``denkf train-reacher``: trains the reacher's filter, or tests the one that comes with the library."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from torch_denkf._checks import check_count
from torch_denkf.cli.command import Command, say

__all__ = ["TrainReacher"]


@dataclass
class TrainReacher(Command):
    """Trains the reacher's filter, or tests the one that comes with the library."""

    out: Path  # folder of the filter, with all its training needs
    seed: int = 0  # of all random numbers
    threads: int = 1  # of torch
    evaluate: bool = False  # test the library's filter and train none

    name, example, resumable = "train-reacher", "denkf train-reacher --out runs/reacher", True

    def run(self) -> None:
        """Trains and tests."""
        import torch

        from torch_denkf.applications.reacher.train import evaluate_reacher, train_reacher
        from torch_denkf.pretrained import from_pretrained

        check_count("--threads", self.threads)
        torch.set_num_threads(self.threads)
        if self.evaluate:
            model = from_pretrained("reacher")
        else:
            model = train_reacher(self.out, seed=self.seed, command=self.command_line)
        say(json.dumps(evaluate_reacher(model), indent=1))
