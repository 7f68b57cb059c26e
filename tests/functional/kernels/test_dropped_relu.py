"""ReLU and dropout in one: against both, one after the other, through every kind of derivative."""

import pytest
import torch

from torch_denkf.functional.kernels.dropped_relu import dropped_relu
from torch_denkf.functional.kernels.random_bits import dropout_factor, random_bytes

RATE = 0.25


def case(seed=0, shape=(6, 4)):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(shape, dtype=torch.float64, generator=generator)
    return x, dropout_factor(random_bytes(shape, generator=generator), RATE, torch.float64)


def plain(x, factor):
    return torch.relu(x) * factor


def ours(x, factor):
    return dropped_relu(x, factor, RATE)


def test_value_and_gradient_are_those_of_relu_and_dropout():
    x, factor = case()
    assert (factor == 0).any()
    assert (factor > 0).any()
    assert (x > 0).any()
    assert ours(x, factor).equal(plain(x, factor))  # without a gradient
    leaf = x.clone().requires_grad_()
    out = ours(leaf, factor)
    assert out.equal(plain(x, factor))
    gradient = torch.randn_like(x)
    expected = torch.autograd.grad(plain(leaf, factor), leaf, gradient)[0]
    torch.testing.assert_close(torch.autograd.grad(out, leaf, gradient)[0], expected)


def test_first_and_second_derivatives_against_finite_differences():
    x, factor = case(1)
    leaf = x.requires_grad_()
    assert torch.autograd.gradcheck(lambda value: ours(value, factor), leaf, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda value: ours(value, factor).square(), leaf)


@pytest.mark.parametrize("derivative", [torch.func.jacrev, torch.func.jacfwd, torch.func.hessian])
def test_torch_func(derivative):
    """As the extended Kalman filter takes Jacobians: by torch.func, inside vmap, of a weight that is trained."""
    x, factor = case(2)
    weight = torch.full((4,), 1.5, dtype=torch.float64, requires_grad=True)

    def jacobian(function):
        return torch.func.vmap(derivative(lambda row, f: function(row * weight, f).square().sum(-1)))(x, factor)

    torch.testing.assert_close(jacobian(ours), jacobian(plain))
    expected = torch.autograd.grad(jacobian(plain).sum(), weight, allow_unused=True)[0]
    torch.testing.assert_close(torch.autograd.grad(jacobian(ours).sum(), weight, allow_unused=True)[0], expected)
