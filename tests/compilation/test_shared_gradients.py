"""Compares gradients that steps share with those of each step by itself, for all ways to differentiate a graph."""

import pytest
import torch
from torch import nn

from torch_denkf.compilation import shared_gradients
from torch_denkf.compilation.shared_gradients import shared, sharing


class Chain(nn.Module):
    """Applies the same layers in each step, on what the step before left."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 3))

    def scan(self, x, steps=4):
        with sharing():
            for _ in range(steps):
                for layer in self.layers:
                    x = shared(layer)(x)
        return x


@pytest.fixture
def chain(float64):
    return Chain()


def alone(chain, x):
    """Returns the gradients without sharing."""
    out = x
    for _ in range(4):
        out = chain.layers(out)
    return torch.autograd.grad(out.square().sum(), (*chain.parameters(), x))


@pytest.mark.parametrize("largest", [1, 40, 2**25])
def test_gradients(chain, monkeypatch, largest):
    monkeypatch.setattr(shared_gradients, "LARGEST_KEPT", largest)  # what is kept is multiplied before, at times
    x = torch.randn(2, 6, 3, requires_grad=True)
    out = chain.scan(x)
    ours = torch.autograd.grad(out.square().sum(), (*chain.parameters(), x))
    for mine, other in zip(ours, alone(chain, x), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-12, atol=1e-12)
    assert shared(chain.layers[0]) is chain.layers[0]


def test_a_part_of_the_gradients_first(chain):
    x = torch.randn(6, 3, requires_grad=True)
    out, expected = chain.scan(x).square().sum(), alone(chain, x)
    torch.testing.assert_close(torch.autograd.grad(out, x, retain_graph=True)[0], expected[-1])
    first = chain.layers[0].weight
    torch.testing.assert_close(torch.autograd.grad(out, first, retain_graph=True)[0], expected[0])
    out.backward()
    for parameter, gradient in zip(chain.parameters(), expected, strict=False):
        torch.testing.assert_close(parameter.grad, gradient)


def test_gradients_of_gradients(chain):
    x = torch.randn(6, 3, requires_grad=True)
    found = []
    for out in (chain.scan(x), chain.layers(chain.layers(chain.layers(chain.layers(x))))):
        gradients = torch.autograd.grad(out.square().sum(), [*chain.parameters()], create_graph=True)
        found.append(torch.autograd.grad(sum(g.square().sum() for g in gradients), x)[0])
    torch.testing.assert_close(*found)


def test_frozen_layers_and_hooks_are_left_alone(chain):
    seen = []
    chain.layers[0].requires_grad_(False)
    chain.layers[2].register_forward_hook(lambda *_: seen.append(1))
    chain.scan(torch.randn(6, 3, requires_grad=True)).sum().backward()
    assert len(seen) == 4
    assert chain.layers[0].weight.grad is None
    assert chain.layers[2].weight.grad is not None
