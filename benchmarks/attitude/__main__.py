"""The command line of the study: ``python -m benchmarks.attitude --help``."""

from benchmarks.attitude.study import main

if __name__ == "__main__":
    main()
