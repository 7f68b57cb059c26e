"""The command line of the study: ``python -m benchmarks.smoothing --help``."""

from benchmarks.smoothing.study import main

if __name__ == "__main__":  # worker processes import this file, too
    main()
