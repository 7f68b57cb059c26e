"""``denkf train-ur5``: trains the UR5 table's filter, or tests the one that comes with the library."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from torch_denkf._checks import check_count
from torch_denkf.cli.command import Command, say

__all__ = ["TrainUR5"]


@dataclass
class TrainUR5(Command):
    """Trains the UR5 table's filter, or tests the one that comes with the library."""

    out: Path  # folder of the filter, with all its training needs
    seed: int = 0  # of all random numbers
    threads: int = 1  # of torch
    evaluate: bool = False  # test the library's filter and train none

    name, example, resumable = "train-ur5", "denkf train-ur5 --out runs/ur5-table", True

    def run(self) -> None:
        """Trains, and tests with all frames and with fewer."""
        import torch

        from torch_denkf.applications.ur5.train import evaluate_ur5_table, train_ur5_table, whole_demos
        from torch_denkf.pretrained import from_pretrained

        check_count("--threads", self.threads)
        torch.set_num_threads(self.threads)
        if self.evaluate:
            model = from_pretrained("ur5-table")
        else:
            model = train_ur5_table(self.out, seed=self.seed, command=self.command_line)
        demos, cache = whole_demos(self.out), self.out / "cache"
        scores = {
            f"{share:.0%} of the frames missing": evaluate_ur5_table(model, demos, missing=share, cache=cache)
            for share in (0.0, 0.3)
        }
        say(json.dumps(scores, indent=1))
