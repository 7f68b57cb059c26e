"""Mixtures of two beliefs: against their closed forms, finite differences, and readings far out."""

import math

import pytest
import torch
from torch.testing import assert_close

from torch_denkf.imperfect.mixture import log_mixture, mix_members, mix_moments, responsibility


def cov(members):
    anomalies = members - members.mean(-2, keepdim=True)
    return anomalies.mT @ anomalies / (members.shape[-2] - 1)


def updated(size, dim, *, dtype=torch.float64, seed=0):
    """Returns members, and what an update in their own span leaves of them: shrunk, turned a little and moved."""
    torch.manual_seed(seed)
    before = torch.randn(2, size, dim, dtype=dtype)
    before[..., 1] = 3 * before[..., 0]  # known together
    before[..., 2] = 7.0  # known
    anomalies = before - before.mean(-2, keepdim=True)
    turn = 0.6 * torch.eye(size, dtype=dtype) + 0.05 * torch.randn(size, size, dtype=dtype)
    after = before.mean(-2, keepdim=True) + turn @ anomalies + torch.randn(2, 1, size, dtype=dtype) @ anomalies
    return after, before


@pytest.mark.parametrize("dim", [3, 5, 12])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_members_have_the_moments_of_the_mixture(dim, dtype):
    """Also of more components than members, and of components that do not differ."""
    after, before = updated(7, dim, dtype=dtype)
    share = torch.tensor([[0.3], [0.9]], dtype=dtype)
    mixed = mix_members(share, after, before)
    mean, whole = mix_moments(share, after.mean(-2), cov(after), before.mean(-2), cov(before))
    tolerance = 1e-5 if dtype == torch.float32 else 1e-10
    scale = whole.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
    assert_close(mixed.mean(-2), mean, rtol=tolerance, atol=tolerance)
    assert_close(cov(mixed) / scale, whole / scale, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_share_of_one_and_of_zero(dtype):
    after, before = updated(7, 9, dtype=dtype)
    for share, expected in ((1.0, after), (0.0, before)):
        mixed = mix_members(torch.full((2, 1), share, dtype=dtype), after, before)
        assert_close(mixed, expected, rtol=0, atol=30 * torch.finfo(dtype).eps)


def test_further_components_do_not_change_the_first():
    after, before = updated(7, 9)
    share = torch.tensor([[0.4], [0.7]], dtype=torch.float64)
    assert_close(
        mix_members(share, after, before)[..., :4],
        mix_members(share, after[..., :4], before[..., :4]),
        rtol=0,
        atol=1e-12,
    )


def test_the_order_and_the_units_of_components_are_kept():
    after, before = updated(9, 4)
    unit = torch.tensor([1e-4, 1.0, 10.0, 1e5], dtype=torch.float64)
    share = torch.tensor([[0.4], [0.7]], dtype=torch.float64)
    assert_close(mix_members(share, after * unit, before * unit), mix_members(share, after, before) * unit)


def test_gradients_are_those_of_finite_differences():
    after, before = updated(6, 4)
    after[..., 1], after[..., 2] = torch.randn(2, 2, 6, dtype=torch.float64)
    before[..., 1], before[..., 2] = torch.randn(2, 2, 6, dtype=torch.float64)
    share = torch.tensor([[0.3], [0.9]], dtype=torch.float64)
    inputs = [value.requires_grad_() for value in (share, after, before)]
    assert torch.autograd.gradcheck(mix_members, inputs, atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_gradients_are_finite_where_components_do_not_differ(share):
    after, before = updated(5, 6, dtype=torch.float32)
    inputs = [value.requires_grad_() for value in (torch.full((2, 1), share), after, before)]
    gradients = torch.autograd.grad(mix_members(*inputs).square().sum(), inputs)
    assert all(gradient.isfinite().all() and gradient.abs().max() < 1e4 for gradient in gradients)


def test_shares_and_densities_are_their_closed_forms():
    p = torch.tensor([0.2, 0.9], dtype=torch.float64)
    own, other = torch.tensor([0.3, 0.02], dtype=torch.float64), torch.tensor([0.1, 0.4], dtype=torch.float64)
    total = p * own + (1 - p) * other
    assert_close(responsibility(p, own.log(), other.log()), p * own / total)
    assert_close(log_mixture(p, own.log(), other.log()), total.log())


def test_certain_and_impossible():
    for p, share, density in ((1.0, 1.0, -5e5), (0.0, 0.0, -3.0)):
        values = torch.tensor(p), torch.tensor(-5e5), torch.tensor(-3.0)
        assert responsibility(*values).item() == share
        assert log_mixture(*values).item() == density


def test_logarithms_hold_far_out():
    """NIS of 1e6 in single precision: nothing overflows, and the gradient by p is the closed form, -1 / (1 - p)."""
    p = torch.tensor(0.9, requires_grad=True)
    own = torch.tensor(-5e5, requires_grad=True)
    value = log_mixture(p, own, torch.tensor(-3.0)) + responsibility(p, own, torch.tensor(-3.0))
    by_p, by_own = torch.autograd.grad(value, [p, own])
    assert value.item() == pytest.approx(math.log(0.1) - 3, rel=1e-5)
    assert by_p.item() == pytest.approx(-10, rel=1e-5)
    assert by_own.item() == 0
