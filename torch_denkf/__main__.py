"""Runs the command line by ``python -m torch_denkf``, where the script ``denkf`` is not on the path."""

from torch_denkf.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
