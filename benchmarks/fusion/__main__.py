"""The command line of the study: ``python -m benchmarks.fusion --help``."""

from benchmarks.fusion.study import main

if __name__ == "__main__":  # worker processes import this file, too
    main()
