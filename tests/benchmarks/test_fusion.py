"""The study of several sensors: what is simulated, what fails, and the rows that come of it."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from benchmarks.fusion.car import car_task
from benchmarks.fusion.study import Study, page
from benchmarks.fusion.task import add_features, faulty, without


@pytest.fixture(scope="module")
def task():
    return car_task(None, frames=8)


def test_faults_are_in_the_given_steps(task):
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


def test_features_count_in_standard_deviations_of_the_sensor():
    data = TensorDict({"a": torch.tensor([0.0, 2.0, 0.0, 2.0, 0.0, 2.0, 0.0]).reshape(1, 7, 1)}, [1, 7])
    data["a_observed"] = torch.ones(1, 7, 1, dtype=torch.bool)
    features = add_features(data, {"a": torch.tensor([4.0])})["a_features"]
    assert_close(features[0, -1, 0], torch.tensor(0.5 + 0.01).log())
    assert (features[..., 1] == 0).all()


def test_medians_over_the_seeds_and_the_worst_training():
    row = {"task": "KITTI", "sensors": "wheels + gps", "condition": "gps: frozen", "error_without": 1.0}
    found = [
        {**row, "method": method, "seed": seed, "error": ratio, "error_ratio": ratio}
        for method in ("plain", "weights")
        for seed, ratio in enumerate((1.0, 5.0, 1.2))
    ]
    assert "| gps: frozen | 1.2 | 1.2 | 1 | 1.2 | 1.2 | 5 |" in page(found, Study())
