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
from typing import Any

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
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the filter, with all that its training needs"
    )
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--evaluate", action="store_true", help="test the library's filter and train none")
    args = parser.parse_args(words)
    torch.set_num_threads(args.threads)
    options = {"seed": args.seed, "command": f"{parser.prog} {shlex.join(words)}"}
    run = _reacher if args.name == "reacher" else _ur5_table
    scores = run(args.out, args.evaluate, options)
    sys.stdout.write(json.dumps(scores, indent=1) + "\n")
    return 0


def _reacher(out: Path, evaluate: bool, options: dict[str, Any]) -> dict[str, Any]:
    from torch_denkf.pretrained.train.reacher import evaluate_reacher, train_reacher

    model = from_pretrained("reacher") if evaluate else train_reacher(out, **options)
    return evaluate_reacher(model)


def _ur5_table(out: Path, evaluate: bool, options: dict[str, Any]) -> dict[str, Any]:
    from torch_denkf.pretrained.train.ur5_table import evaluate_ur5_table, train_ur5_table, whole_demos

    model = from_pretrained("ur5-table") if evaluate else train_ur5_table(out, **options)
    demos = whole_demos(out)
    return {
        f"{share:.0%} of the frames missing": evaluate_ur5_table(model, demos, missing=share, cache=out / "cache")
        for share in (0.0, 0.3)
    }


if __name__ == "__main__":
    raise SystemExit(main())
