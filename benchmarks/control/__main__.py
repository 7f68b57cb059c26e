"""The command line of the study: ``python -m benchmarks.control --help``."""

from benchmarks.control.study import main

if __name__ == "__main__":
    main()
