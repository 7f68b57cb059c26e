"""The command line of the study: ``python -m benchmarks.broad --help``."""

from benchmarks.broad.study import main

if __name__ == "__main__":
    main()
