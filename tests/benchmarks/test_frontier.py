"""Oracles: the points of the lines that were drawn, and filters that must follow a record."""

import matplotlib.pyplot as plt
import pytest
import torch
from tensordict import TensorDict

from benchmarks.common import plots
from benchmarks.common.scores import processor_ms
from benchmarks.lorenz96.frontier import COLUMNS, candidates, row_of
from benchmarks.lorenz96.schemes import simulate

ROWS = [
    {"filter": "a", "members": 64, "ms_per_step": 0.4, "rmse": 0.2},
    {"filter": "a", "members": 8, "ms_per_step": 0.1, "rmse": 0.3},
    {"filter": "b", "members": 1, "ms_per_step": 0.2, "rmse": 0.25},
    {"filter": "c", "members": 8, "ms_per_step": 0.2, "rmse": 4.0},
]


def test_a_line_is_drawn_for_each_filter_in_order_of_members(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(plt, "close", kept.append)
    plots.draw_frontier(ROWS, tmp_path / "a.png", error="rmse", label="RMSE", limit=2.0)
    (axis,) = kept[0].axes
    lines = {line.get_label(): line.get_xydata().tolist() for line in axis.lines}
    assert lines == {"a": [[0.1, 0.3], [0.4, 0.2]], "b": [[0.2, 0.25]]}
    assert [text.get_text() for text in axis.texts] == ["8", "64"]
    assert axis.get_title() == "not shown, with an error above 2: 1"
    assert (tmp_path / "a.png").stat().st_size > 1000
    with pytest.raises(ValueError, match="no rows to draw of 1"):
        plots.draw_frontier(ROWS[-1:], tmp_path / "b.png", error="rmse", label="RMSE", limit=2.0)


def test_processor_time_does_not_count_sleep():
    import time

    assert processor_ms(lambda: time.sleep(0.02), steps=1, runs=2) < 10


@pytest.fixture(scope="module")
def records():
    truth, observations = (part.float().transpose(0, 1) for part in simulate(4, 80))
    data = TensorDict({"state": truth, "observation": observations}, batch_size=truth.shape[:2])
    return dict(zip(("validation", "test"), data.split(2), strict=True))


@pytest.mark.parametrize("name", ["DEnKF, stochastic", "DEnKF, etkf", "DEnKF, sakov", "EKF", "UKF"])
def test_filters_follow_lorenz96_better_than_its_readings(name, records):
    found = candidates((24,))
    size = 1 if name in ("EKF", "UKF") else 24
    settings = dict(list(found[name, size].items())[2:4])  # two of them: it chooses
    row = row_of(name, size, settings, records, skip=20, chunk=0)
    assert row["rmse"] < 0.45  # readings: 1; published for long records: 0.18 to 0.24
    assert set(row) == set(COLUMNS.names)
    assert row["setting"] in settings
    assert row["ms_per_step"] > 0


def test_a_diverged_setting_is_not_chosen(records):
    found = candidates((8,))["DEnKF, stochastic", 8]
    bad, good = found["radius none, inflation 1.0"], found["radius 4.0, inflation 1.07"]
    torch.manual_seed(0)
    assert row_of("a", 8, {"bad": bad, "good": good}, records, skip=40, chunk=0)["setting"] == "good"
