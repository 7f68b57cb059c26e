"""The study of several sensors: what is simulated, what fails, and the rows that come of it."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from benchmarks.fusion import training
from benchmarks.fusion.arm import finer
from benchmarks.fusion.car import DT, START, car_task, readings, simulated
from benchmarks.fusion.study import COLUMNS, Study, page, rows
from benchmarks.fusion.task import add_features, delayed, faulty, last_seen, without
from benchmarks.fusion.training import make_weights, train


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


def test_a_window_may_begin_anywhere_and_its_start_is_as_wrong_as_the_filter_expects():
    data = readings(*simulated(60, 0, count=20), 0)
    wrong = (data["start"] - data["state"]) / START
    assert_close(wrong.mean((0, 1)), torch.zeros(5), rtol=0, atol=0.05)
    assert_close(wrong.std((0, 1)), torch.ones(5), rtol=0, atol=0.05)


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
            assert (out["wheels_features"][:, 16:20, :2] < task.test["wheels_features"][:, 16:20, :2]).all()
            assert out["wheels_features"][0, 8:22, 2].tolist() == [0, 0, 1, 2, 3, 4, *[5] * 6, 0, 0]
        if fault == "noise":
            assert change[:, 10:20].std() > 1
    assert not without(task.test, "gps")["gps_observed"].any()


def test_a_slow_sensor_is_frozen_at_its_last_reading(task):
    data = without(task.test, "gps")
    data["gps_observed"][:, [3, 9, 12]] = True
    begin, end = torch.tensor([8, 8]), torch.tensor([30, 30])
    out = faulty(task, data, "gps", "frozen", begin, end, torch.Generator())
    assert last_seen(data, "gps")[0, [2, 3, 8, 9, 34], 0].tolist() == [0, 3, 3, 9, 12]
    assert (out["gps"][:, 9:13] == data["gps"][:, 3:4]).all()
    assert out["gps_features"][0, [3, 8, 9, 11, 12, 34], 2].tolist() == [0, 0, 1, 1, 2, 2]


def test_features_count_in_standard_deviations_of_the_sensor():
    data = TensorDict({"a": torch.tensor([0.0, 2.0, 0.0, 2.0, 0.0, 2.0, 0.0]).reshape(1, 7, 1)}, [1, 7])
    data["a_observed"] = torch.ones(1, 7, 1, dtype=torch.bool)
    features = add_features(data, {"a": torch.tensor([4.0])})["a_features"]
    assert_close(features[0, -1, 0], torch.tensor(0.5 + 0.01).log())
    assert (features[..., 1] == 0).all()


def test_what_is_late_comes_later():
    data = TensorDict({"a": torch.arange(6.0).reshape(1, 6, 1)}, [1, 6])
    data["a_observed"] = torch.ones(1, 6, 1, dtype=torch.bool)
    data["a_late"] = torch.zeros(1, 6, 1, dtype=torch.int64)
    out = delayed(add_features(data, {"a": torch.ones(1)}), "a", 2)
    assert out["a"][0, 2:, 0].tolist() == [0, 1, 2, 3]
    assert out["a_observed"].flatten().tolist() == [False] * 2 + [True] * 4
    assert (out["a_late"] == 2).all()


def test_what_the_trainings_see(monkeypatch):
    """A third of the windows lacks a sensor; in a half of those for the weights one fails, after the start-up."""
    task, seen = car_task(None, frames=60), []
    monkeypatch.setattr(training, "fit", lambda model, loss, sample, *_: seen.append(sample()))
    train(task, make_weights(task), updates=(1, 1), window=200, batch=60)
    begin = task.settled.start
    assert begin == round(0.5 * task.rate)
    for number, windows in enumerate(seen):
        absent = torch.stack([~windows[f"{name}_observed"].any(1).squeeze(-1) for name in task.sensors])
        assert absent.any(0).sum() == 20
        assert (absent.sum(0) <= 1).all()
        clean = torch.zeros(60, dtype=torch.bool)
        for row, window in enumerate(windows):
            starts = (task.train["state"][:, :96] == window["state"][0]).all(-1).nonzero()
            recording, start = starts[0]
            same = [(window[name] == task.train[recording, start : start + 200][name]).all(-1) for name in task.sensors]
            assert all(values[:begin].all() for values in same)
            clean[row] = all(values.all() for values in same)
        assert clean.sum() == (60, 30)[number]


def test_medians_over_the_seeds_and_the_worst_training():
    row = {"task": "KITTI", "sensors": "wheels + gps", "condition": "gps: frozen", "error_without": 1.0}
    found = [
        {**row, "method": method, "seed": seed, "error": ratio, "error_ratio": ratio}
        for method in ("plain", "weights")
        for seed, ratio in enumerate((1.0, 5.0, 1.2))
    ]
    assert "| gps: frozen | 1.2 | 1.2 | 1 | 1.2 | 1.2 | 5 |" in page(found, Study())


def test_rows_and_page(task, tmp_path):
    found = [{**row, "seed": 0} for row in rows(task, make_weights(task))]
    assert len(found) == 2 * (7 + 9) + 6
    for row in found:
        if "error_ratio" in row:
            assert row["error_ratio"] == pytest.approx(row["error"] / row["error_without"])
    COLUMNS.write(found, tmp_path / "fusion.csv")
    assert len(COLUMNS.read(tmp_path / "fusion.csv")) == len(found)
    assert "| wheels: frozen |" in page(found, Study())
