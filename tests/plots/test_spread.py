"""Oracles: a Kalman filter, whose spread is its error, and bins by hand."""

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.plots import plot_spread_error


def data(axes):
    return {line.get_label(): np.stack(line.get_data()) for line in axes.get_lines()}


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
