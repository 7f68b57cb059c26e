"""The command line of the study: ``python -m benchmarks.occlusion --help``."""

from benchmarks.occlusion.study import main

if __name__ == "__main__":
    main()
