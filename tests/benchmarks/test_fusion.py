"""The study of several sensors: what is simulated, what fails, and the rows that come of it."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from benchmarks.fusion.arm import finer
from benchmarks.fusion.car import DT, car_task, readings, simulated
from benchmarks.fusion.study import COLUMNS, Study, page, rows
from benchmarks.fusion.task import add_features, delayed, faulty, without
from benchmarks.fusion.training import make_weights


def test_finer_paths_go_through_the_coarse_ones_and_are_smooth():
    time = torch.linspace(0, 3, 20).reshape(1, -1, 1)
    path = finer(time.sin())
    assert_close(path[:, ::8], time.sin())
    exact = torch.linspace(0, 3, 19 * 8 + 1)[: 18 * 8].sin()
    assert_close(path[0, 8 : 18 * 8, 0], exact[8:], rtol=0, atol=1e-3)


def test_a_car_at_fifty_hertz_is_where_it_is_at_ten():
    states, camera = simulated(10, 0)
    data = readings(states, camera, 0)
    assert_close(data["state"][:, 4::5], states[:, 1:], rtol=0, atol=1e-4)
    way = (data["state"][:, 1:, :2] - data["state"][:, :-1, :2]).norm(dim=-1)
    assert_close(way, data["state"][:, 1:, 3] * DT, rtol=0, atol=1e-4)
    seen = data["camera_observed"][..., 0]
    assert_close(data["camera"][seen].reshape(2, 9, 2), camera[:, 1:])


@pytest.fixture(scope="module")
def task():
    return car_task(None, frames=8)


def test_faults_are_where_they_are_said_to_be(task):
    generator = torch.Generator().manual_seed(0)
    begin, end = torch.tensor([10, 10]), torch.tensor([20, 20])
    for fault in ("frozen", "offset", "noise"):
        out = faulty(task, task.test, "wheels", fault, begin, end, generator)
        change = out["wheels"] - task.test["wheels"]
        assert (change[:, [*range(10), *range(20, 35)]] == 0).all()
        if fault == "offset":
            assert_close(change[:, 10:20], task.offsets["wheels"].expand(2, 10, 2))
        if fault == "frozen":
            assert (out["wheels"][:, 10:20] == task.test["wheels"][:, 9:10]).all()
            assert (out["wheels_features"][:, 16:20] < task.test["wheels_features"][:, 16:20]).all()
        if fault == "noise":
            assert change[:, 10:20].std() > 1
    assert not without(task.test, "gps")["gps_observed"].any()


def test_what_is_late_comes_later():
    data = TensorDict({"a": torch.arange(6.0).reshape(1, 6, 1)}, [1, 6])
    data["a_observed"] = torch.ones(1, 6, 1, dtype=torch.bool)
    data["a_late"] = torch.zeros(1, 6, 1, dtype=torch.int64)
    out = delayed(add_features(data, "a"), "a", 2)
    assert out["a"][0, 2:, 0].tolist() == [0, 1, 2, 3]
    assert out["a_observed"].flatten().tolist() == [False] * 2 + [True] * 4
    assert (out["a_late"] == 2).all()


def test_rows_and_page(task, tmp_path):
    found = rows(task, make_weights(task))
    assert len(found) == 2 * (7 + 9) + 6
    for row in found:
        if "error_ratio" in row:
            assert row["error_ratio"] == pytest.approx(row["error"] / row["error_without"])
    COLUMNS.write(found, tmp_path / "fusion.csv")
    assert len(COLUMNS.read(tmp_path / "fusion.csv")) == len(found)
    assert "| wheels: frozen |" in page(found, Study())
