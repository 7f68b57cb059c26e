"""The command line of the study: ``python -m benchmarks.gpu --help``."""

from benchmarks.gpu.study import main

if __name__ == "__main__":
    main()
