"""``denkf train-reacher``: trains the reacher's filter, or tests the one that comes with the library."""

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
    from torch_denkf.applications.reacher.train import evaluate_reacher, train_reacher

    torch.set_num_threads(args.threads)
    if args.evaluate:
        model = from_pretrained("reacher")
    else:
        model = train_reacher(args.out, seed=args.seed, command=args.command_line)
    scores = evaluate_reacher(model)
    say(json.dumps(scores, indent=1))


main = Command(
    "train-reacher",
    "Trains the reacher's filter, or tests the one that comes with the library.",
    "denkf train-reacher --out runs/reacher",
    _arguments,
    _run,
    resumable=True,
)

if __name__ == "__main__":
    raise SystemExit(main())
