"""Oracles: a Kalman filter, whose spread is its error, and bins by hand."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.plots.runs_for_tests import kalman_runs
from torch_denkf.functional.manifolds import Circle, Euclidean
from torch_denkf.plots import plot_spread_error


def data(axes):
    return {line.get_label(): np.stack(line.get_data()) for line in axes.get_lines()}


def test_a_kalman_filter_lies_on_the_diagonal():
    axes = plot_spread_error(kalman_runs()[:, 5:], dims=[0, 1], names=["x, m", "y, m"], bins=6)
    drawn = data(axes)
    for name in ("x, m", "y, m"):
        spread, error = drawn[name]
        assert spread[-1] > 1.4 * spread[0]  # missing readings widen it
        assert (np.diff(spread) > 0).all()
        np.testing.assert_allclose(error, spread, rtol=0.15)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("predicted spread, m", "RMS error, m")
    (start, end) = drawn["spread = error"].T
    assert start.tolist() == [0, 0]
    assert end[0] == end[1] >= max(drawn["x, m"].max(), drawn["y, m"].max())
    assert axes.get_xlim() == axes.get_ylim() == (0, end[0])


def test_points_by_hand():
    std = torch.tensor([1.0, 1.0, 3.0, 3.0]).reshape(2, 2, 1)
    truth = torch.tensor([1.0, -1.0, 2.0, -2.0]).reshape(2, 2, 1)
    belief = TensorDict({"mean": 0 * std, "var": std**2}, [2, 2])
    axes = plot_spread_error(belief, truth, factors=[10], bins=2)
    np.testing.assert_allclose(data(axes)["state 0"], [[10, 30], [10, 20]])
    assert axes.get_xlabel() == "predicted spread"
    low, high = axes.get_xlim()
    assert low < 10
    assert high > 30


def test_angles_are_wrapped():
    belief = TensorDict({"mean": torch.tensor([[0.0, 3.1]]), "var": torch.ones(1, 2)}, [1])
    axes = plot_spread_error(
        belief, torch.tensor([[0.0, -3.1]]), dims=[1], space=Euclidean(1) * Circle(), factors=[1.0], bins=1
    )
    assert data(axes)["heading, deg"][1, 0] == pytest.approx(2 * np.pi - 6.2, abs=1e-6)
