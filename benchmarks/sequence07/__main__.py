"""The command line of the study: ``python -m benchmarks.sequence07 --help``."""

from benchmarks.sequence07.study import main

if __name__ == "__main__":
    main()
