import pytest
import torch

from benchmarks.wheels.study import row
from benchmarks.wheels.task import NAMES, ensemble_filter, gaussian_filter, recordings


@pytest.fixture(scope="module")
def data():
    return recordings(runs=8, steps=2000, seed=5)


def test_sensors_read_at_their_rates(data):
    shares = [data[f"{name}_observed"].float().mean().item() for name in ("gyro", "wheels", "gps")]
    assert shares == pytest.approx([1.0, 0.2, 0.01])
    bias = (data["gyro"] - data["state"][..., 4:5]).mean(1)
    torch.testing.assert_close(bias, data["state"][..., 5:6].mean(1), rtol=0, atol=1e-3)


@pytest.mark.slow
def test_few_members_are_as_honest_as_the_kalman_filter_where_chance_is_not_believed(data):
    """20 s are 2,400 updates. The table of the study says the same of 60 s."""
    kalman, plain = row(gaussian_filter(), data), row(ensemble_filter(64), data)
    honest = row(ensemble_filter(64, localisation="significance"), data)
    assert min(plain[name] for name in ("x", "y", "heading")) < 0.4
    assert all(honest[name] > 0.7 for name in NAMES)
    # Eight runs: 10 % of a root mean square error are within what other members give.
    assert honest["error_x"] + honest["error_y"] < 1.25 * (kalman["error_x"] + kalman["error_y"])
    assert plain["error_x"] + plain["error_y"] > 1.5 * (honest["error_x"] + honest["error_y"])
