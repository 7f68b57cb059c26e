"""The command line of the study: ``python -m benchmarks.wheels --help``."""

from benchmarks.wheels.study import main

if __name__ == "__main__":
    main()
