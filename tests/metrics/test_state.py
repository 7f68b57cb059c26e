"""Oracles: numbers by hand, and NumPy."""

import math

import numpy as np
import pytest
import torch

from tests.functional.checks import assert_raises
from torch_denkf.functional.manifolds import Circle, Flat
from torch_denkf.metrics import state_errors
from torch_denkf.metrics.state import state_difference


def test_errors_equal_values_by_hand():
    truth = torch.tensor([[[0.0, 3.0, 1.0], [0.0, -3.0, 1.0]]], dtype=torch.float64)
    estimated = torch.tensor([[[3.0, -3.0, 1.0], [-1.0, -2.5, 1.0]]], dtype=torch.float64)
    turn = 2 * math.pi - 6  # from 3 to -3 rad, to the left
    space = Flat(3, circular=[1])
    difference = state_difference(estimated, truth, space=space)
    torch.testing.assert_close(difference, torch.tensor([[[3.0, turn, 0.0], [-1.0, 0.5, 0.0]]]).double())
    errors = state_errors(estimated, truth, space=space)
    torch.testing.assert_close(errors.mae, torch.tensor([2.0, (turn + 0.5) / 2, 0.0]).double())
    torch.testing.assert_close(errors.rmse, torch.tensor([math.sqrt(5), math.sqrt((turn**2 + 0.25) / 2), 0.0]).double())
    # Without angles 6 rad is 6 rad.
    torch.testing.assert_close(state_errors(estimated, truth).mae[1].item(), 3.25)


def test_all_batch_dims_and_numpy():
    rng = torch.Generator().manual_seed(0)
    estimated, truth = torch.randn(2, 4, 5, 7, 3, generator=rng, dtype=torch.float64).unbind(0)
    before = estimated.clone()
    errors = state_errors(estimated, truth, space=Flat(3, circular=[0]))
    assert estimated.equal(before)
    difference = (estimated - truth).numpy().reshape(-1, 3)
    difference[:, 0] = np.angle(np.exp(1j * difference[:, 0]))
    np.testing.assert_allclose(errors.rmse, np.sqrt((difference**2).mean(0)))
    np.testing.assert_allclose(errors.mae, np.abs(difference).mean(0))
    assert state_errors(estimated[0, 0, 0], truth[0, 0, 0]).mae.shape == (3,)


def test_gradients_go_through_wrapped_angles():
    estimated = torch.tensor([[1.0, 3.0]], dtype=torch.float64, requires_grad=True)
    state_difference(
        estimated, torch.tensor([[0.0, -3.0]]).double(), space=Flat(2, circular=[1])
    ).square().sum().backward()
    torch.testing.assert_close(estimated.grad, torch.tensor([[2.0, 2 * (6 - 2 * math.pi)]]).double())


def test_invalid_input_raises():
    assert_raises(ValueError, "for ensembles pass the mean", state_errors, torch.zeros(4, 8, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="point has shape"):
        state_errors(torch.zeros(4, 3), torch.zeros(4, 3), space=Circle())
    assert_raises(ValueError, "no states", state_errors, torch.zeros(0, 3), torch.zeros(0, 3))
