"""The command line of the study: ``python -m benchmarks.members --help``."""

from benchmarks.members.study import main

if __name__ == "__main__":
    main()
