"""``denkf train-ur5``: trains the UR5 table's filter, or tests the one that comes with the library."""

from __future__ import annotations

import argparse
import json

import torch

from torch_denkf.cli._command import Command, path, say, whole
from torch_denkf.pretrained import from_pretrained

__all__ = ["main"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=path, required=True, help="folder of the filter, with all its training needs")
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers")
    parser.add_argument("--threads", type=whole(1), default=1, help="of torch")
    parser.add_argument("--evaluate", action="store_true", help="test the library's filter and train none")


def _run(args: argparse.Namespace) -> None:
    from torch_denkf.applications.ur5.train import evaluate_ur5_table, train_ur5_table, whole_demos

    torch.set_num_threads(args.threads)
    if args.evaluate:
        model = from_pretrained("ur5-table")
    else:
        model = train_ur5_table(args.out, seed=args.seed, command=args.command_line)
    demos = whole_demos(args.out)
    scores = {
        f"{share:.0%} of the frames missing": evaluate_ur5_table(model, demos, missing=share, cache=args.out / "cache")
        for share in (0.0, 0.3)
    }
    say(json.dumps(scores, indent=1))


main = Command(
    "train-ur5",
    "Trains the UR5 table's filter, or tests the one that comes with the library.",
    "denkf train-ur5 --out runs/ur5-table",
    _arguments,
    _run,
    resumable=True,
)

if __name__ == "__main__":
    raise SystemExit(main())
