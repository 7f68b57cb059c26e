"""The command line of the study: ``python -m benchmarks.outliers --help``."""

from benchmarks.outliers.study import main

if __name__ == "__main__":
    main()
