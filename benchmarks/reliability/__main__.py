"""The command line of the study: ``python -m benchmarks.reliability --help``."""

from __future__ import annotations

from benchmarks.common.arguments import run_one
from benchmarks.reliability.fuzz import Fuzz
from benchmarks.reliability.soak import Soak


def main() -> None:
    """Runs one command, or with ``--smoke`` all of them."""
    run_one({"fuzz": Fuzz, "soak": Soak})


if __name__ == "__main__":
    main()
