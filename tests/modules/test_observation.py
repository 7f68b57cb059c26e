"""Oracle: the formula."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.modules import LearnedObservation, LinearObservation, Select

BATCHES = [(), (3,), (2, 3)]


def observe(model, state):
    return model(TensorDict({("forecast", "ensemble"): state}, state.shape[:-2]))["forecast", "observation"]


@pytest.mark.parametrize("batch", BATCHES)
def test_select_keeps_the_order(batch):
    state = torch.randn(*batch, 4, 5)
    model = Select([4, 0, 3])
    assert observe(model, state).equal(torch.stack([state[..., 4], state[..., 0], state[..., 3]], -1))
    assert model.observe(state[..., 0, :]).equal(state[..., 0, [4, 0, 3]])


@pytest.mark.parametrize("batch", BATCHES)
def test_linear(float64, batch):
    matrix, state = torch.randn(2, 5), torch.randn(*batch, 4, 5)
    expected = torch.einsum("os,...es->...eo", matrix, state)
    torch.testing.assert_close(observe(LinearObservation(matrix), state), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("scaled", [True, False])
def test_learned(float64, scaled):
    net, state = nn.Linear(5, 2), torch.randn(3, 4, 5)
    loc, scale = torch.randn(5), torch.rand(5) + 0.5
    model = LearnedObservation(net, loc=loc, scale=scale) if scaled else LearnedObservation(net)
    expected = net((state - loc) / scale if scaled else state)
    assert observe(model, state).equal(expected)
    torch.testing.assert_close(model.observe(state[:, 0]), expected[:, 0], rtol=0, atol=1e-15)


def test_a_network_may_have_attributes_that_are_named_like_our_buffers():
    class Affine(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.register_buffer("loc", torch.tensor([5.0]))
            self.scale = 3.0

        def forward(self, state):
            return self.scale * state + self.loc

    observation = LearnedObservation(Affine(), loc=[1.0], scale=[2.0])
    states = torch.tensor([[3.0], [7.0]])  # standardised: 1 and 3
    predicted = observation(TensorDict({("forecast", "ensemble"): states}))["forecast", "observation"]
    torch.testing.assert_close(predicted, torch.tensor([[8.0], [14.0]]))
