"""The command line of the study: ``python -m benchmarks.monitor --help``."""

from benchmarks.monitor.study import main

if __name__ == "__main__":
    main()
