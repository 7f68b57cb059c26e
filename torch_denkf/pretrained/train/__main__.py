"""Trains one of the library's filters anew, or tests it.

::

    python -m torch_denkf.pretrained.train reacher --out runs/reacher
    python -m torch_denkf.pretrained.train ur5-table --out runs/ur5-table --evaluate

A repeated command goes on where the last one stopped. The filter of the car is trained by
``denkf train --rendered 20 --out runs/car`` and tested by ``denkf evaluate``.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path

import torch

from torch_denkf.pretrained.folders import from_pretrained

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> int:
    """Runs the program; returns the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(
        prog="python -m torch_denkf.pretrained.train",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", choices=["reacher", "ur5-table"])
    parser.add_argument("--out", type=Path, required=True, help="folder of the filter, with all that its training needs")
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--evaluate", action="store_true", help="test the library's filter and train none")
    args = parser.parse_args(words)
    torch.set_num_threads(args.threads)
    command = f"{parser.prog} {shlex.join(words)}"
    if args.name == "reacher":
        from torch_denkf.pretrained.train.reacher import evaluate_reacher, train_reacher

        model = from_pretrained("reacher") if args.evaluate else train_reacher(args.out, seed=args.seed, command=command)
        scores = evaluate_reacher(model)  # type: ignore[arg-type]
    else:
        from torch_denkf.pretrained.train.ur5_table import evaluate_ur5_table, test_demos, train_ur5_table

        model = from_pretrained("ur5-table") if args.evaluate else train_ur5_table(
            args.out, seed=args.seed, command=command
        )
        demos, cache = test_demos(args.out), args.out / "cache"
        scores = {
            f"{share:.0%} of the frames missing": evaluate_ur5_table(model, demos, missing=share, cache=cache)  # type: ignore[arg-type]
            for share in (0.0, 0.3)
        }
    sys.stdout.write(json.dumps(scores, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
