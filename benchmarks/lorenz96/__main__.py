"""The command line of the study: ``python -m benchmarks.lorenz96 {schemes,ad_enkf,calibration,frontier}``."""

from __future__ import annotations

from benchmarks.common.arguments import run_one
from benchmarks.lorenz96 import ad_enkf, calibration, frontier, schemes

if __name__ == "__main__":
    run_one(
        {
            "schemes": schemes.Schemes,
            "ad_enkf": ad_enkf.ADEnKF,
            "calibration": calibration.Calibration,
            "frontier": frontier.Frontier,
        }
    )
