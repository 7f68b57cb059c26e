"""The command line of the study: ``python -m benchmarks.legged --help``."""

from benchmarks.legged.study import main

if __name__ == "__main__":
    main()
