"""The bars of the pages of results: their numbers are those of the studies' tables."""

import pytest

from benchmarks.common import overview


@pytest.mark.parametrize(
    ("study", "bar", "series", "page", "begins", "column"),
    [
        (overview.smoothing, "lorenz63, EnKS, lag 5", "smoother", "smoothing/results/smoothing", "lorenz63 | EnKS", 6),
        (overview.fusion, "wheels: offset", "plain", "fusion/results/fusion", "wheels: offset", 2),
        (overview.fusion, "wheels: offset", "without that sensor", "fusion/results/fusion", "wheels: offset", 4),
        (overview.monitor, "real: a box", "with an answer", "monitor/results/monitor", "kitti-real | box-all", 5),
        (overview.arms, "reacher, pixels, 30% missing", "belief", "arms/results/table", "30% | belief | 0.54", 5),
        (overview.odometry, "height 1.4 m", "path", "odometry/results/odometry", "1.4 |", 6),
        (overview.reliability, "LSTMFilter", "last steps", "reliability/results/soak", "LSTMFilter", 6),
        (overview.speed, "step / filterpy", "1 at a time", "speed/results/speed", "compiled step / filterpy", 2),
    ],
)
def test_bars_are_those_of_the_tables(study, bar, series, page, begins, column):
    lines = (overview.STUDIES / f"{page}.md").read_text().splitlines()
    row = next(line for line in lines if line.startswith(f"| {begins}"))
    written = row.split("|")[column].split()[0]
    assert study()[1][bar][series] == pytest.approx(float(written), abs=0.6 * 10 ** -len(written.partition(".")[2]))
