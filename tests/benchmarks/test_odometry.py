"""The page of the odometry study, of the recorded rows."""

from pathlib import Path

from benchmarks.odometry.__main__ import COLUMNS, page
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT

RECORDED = Path(__file__).parents[2] / "benchmarks" / "odometry" / "results" / "odometry.csv"


def test_means_and_medians_of_the_recorded_rows():
    """At 1.65 m: 0.0266, 0.0913, 0.0438, 0.0336, 0.0245 m/m and 0.0358, 0.0348, 0.0145, 0.0078, 0.0101 deg/m."""
    rows = sorted(COLUMNS.read(RECORDED), key=lambda row: row["height_m"] != KITTI_HEIGHT)
    lines = page(rows).splitlines()
    assert "| height given, m | m/m, mean | m/m, median | deg/m, mean | deg/m, median | length / true |" in lines
    assert "| 1.65 | 0.044 | 0.034 | 0.021 | 0.014 | 1.035 |" in lines
    assert "| 00 | 200 | 100 | 0.027 | 0.036 | 2.02 | 2.35 | 1.011 | 14 |" in lines
