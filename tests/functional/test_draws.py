"""Draws that are exact to second order, against the moments that they are to have."""

import pytest
import torch

from torch_denkf.functional.draws import exact_draws
from torch_denkf.functional.kernels.random_bits import balanced_bytes


def correlated(members, dim, batch=(50,), scale=1.0):
    return torch.randn(*batch, members, dim) @ torch.randn(dim, dim) * scale + 5


@pytest.mark.parametrize(("members", "dim", "state"), [(32, 2, 5), (32, 5, 5), (64, 20, 20), (11, 2, 5), (5, 2, 0)])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_mean_covariance_and_correlations_are_exact(members, dim, state, scale, float64):
    ensemble = correlated(members, state, scale=scale) if state else None
    draws = exact_draws(torch.randn(50, members, dim), *([] if ensemble is None else [ensemble]))
    assert draws.mean(-2).abs().max() < 1e-9
    torch.testing.assert_close(draws.mT @ draws / (members - 1), torch.eye(dim).expand(50, -1, -1), atol=1e-7, rtol=0)
    if ensemble is not None:
        anomalies = ensemble - ensemble.mean(-2, keepdim=True)
        anomalies = anomalies / anomalies.std(-2, keepdim=True)
        assert (draws.mT @ anomalies).abs().max() / (members - 1) < 1e-5  # the ridge of rank-deficient members


@pytest.mark.parametrize(
    ("members", "dim", "state"), [(32, 5, 5), (8, 3, 6), (8, 6, 6), (8, 7, 3), (6, 9, 4), (4, 3, 40)]
)
def test_exact_draws_are_never_worse_than_random_draws(members, dim, state):
    ensemble = correlated(members, state, (2000,))
    anomalies = ensemble - ensemble.mean(-2, keepdim=True)
    q, errors = torch.eye(dim), []
    for draws in (torch.randn(2000, members, dim), None):
        draws = exact_draws(torch.randn(2000, members, dim), ensemble) if draws is None else draws
        away = draws - draws.mean(-2, keepdim=True)
        moved, before = anomalies @ torch.ones(state, dim), anomalies.mT @ anomalies
        total = (moved + away).mT @ (moved + away) - moved.mT @ moved
        assert before.isfinite().all()
        errors.append(
            torch.stack(
                [
                    draws.mean(-2).square().mean(),
                    (total / (members - 1) - q).square().mean(),
                    (away.mT @ away / (members - 1) - q).square().mean(),
                ]
            )
        )
    assert (errors[1] <= 1.05 * errors[0] + 1e-6).all()  # of 2,000 rows each sum is known to 3 %


def test_members_without_spread_and_draws_without_spread():
    alike = torch.ones(32, 3)
    draws = exact_draws(torch.randn(32, 2), alike)
    torch.testing.assert_close(draws.mT @ draws / 31, torch.eye(2), atol=1e-4, rtol=0)
    assert exact_draws(torch.zeros(32, 2), torch.randn(32, 3)).eq(0).all()
    half = torch.stack([torch.randn(32), torch.zeros(32)], -1)
    assert exact_draws(half)[:, 1].eq(0).all()
    torch.testing.assert_close(exact_draws(half)[:, 0].square().sum() / 31, torch.tensor(1.0), atol=1e-4, rtol=0)


@pytest.mark.parametrize("spread", [0.0, 1e-40, 1e-30, 1e-20, 1e-6, 1e20])
def test_gradients_are_finite_whatever_the_spread(spread):
    """A component that decays for long has squares that single precision does not hold."""
    members = (spread * torch.randn(4, 32, 3)).requires_grad_()
    draws = exact_draws(torch.randn(4, 32, 2), members)
    torch.testing.assert_close(draws.mT @ draws / 31, torch.eye(2).expand(4, 2, 2), atol=1e-4, rtol=0)
    assert (draws.mT @ (members / max(spread, 1e-36))).abs().max() < 1e-2
    assert torch.autograd.grad(draws.pow(3).sum(), members)[0].isfinite().all()


@pytest.mark.parametrize("dim", [4, 6, 9])
def test_with_about_as_many_dimensions_as_members_the_mean_alone_is_exact(dim):
    normal = torch.randn(4, 6, dim)
    torch.testing.assert_close(exact_draws(normal, torch.randn(4, 6, 2)), normal - normal.mean(-2, keepdim=True))


@pytest.mark.parametrize(("further", "room"), [(3, True), (4, False)])
def test_first_draws_have_priority(further, room):
    """Of 12 members 2 draws leave room for 7 directions, whatever the precision of the members."""
    first, second = torch.randn(12, 4), torch.randn(12, further).double()
    draws = exact_draws(torch.randn(12, 2), first, second.float())
    assert (draws.mT @ first).abs().max() < 1e-2
    assert ((draws.double().mT @ second).abs().max() < 1e-2) == room
    assert exact_draws(torch.randn(12, 2), second).dtype == torch.float32


@pytest.mark.parametrize("state", [3, 20])
def test_units_of_the_members_change_nothing(state, float64):
    normal, ensemble = torch.randn(4, 16, 2), torch.randn(4, 16, state)
    units = torch.logspace(-6, 6, state)
    torch.testing.assert_close(exact_draws(normal, ensemble * units), exact_draws(normal, ensemble), rtol=0, atol=1e-6)


def test_the_gradient_is_that_of_finite_differences(float64):
    normal, ensemble = torch.randn(2, 8, 2), torch.randn(2, 8, 3, requires_grad=True)
    assert torch.autograd.gradcheck(lambda members: exact_draws(normal, members), ensemble, atol=1e-5)


@pytest.mark.parametrize("members", [2, 5, 16, 30, 32, 64, 100, 512])
def test_each_unit_is_dropped_in_the_same_share_of_the_members(members):
    draws = balanced_bytes((20,), members, 300)
    dropped = (draws < 26).sum(-2)
    share = 26 / 256 * members
    assert dropped.min() >= int(share)
    assert dropped.max() <= -(-26 * members // 256)
    assert abs((draws < 26).float().mean() - 26 / 256) < 4 * (0.25 / (20 * 300 * members)) ** 0.5 + 0.01
    single = balanced_bytes((20_000,), members, 1)[:, 0, 0].double()  # one byte by itself is uniform
    assert abs(single.mean() - 127.5) < 4 * 73.9 / 20_000**0.5
    assert abs(single.var() / 5461.25 - 1) < 0.04


def test_units_are_dropped_independently_of_each_other():
    dropped = (balanced_bytes((4000,), 32, 8) < 64).double()
    joint = (dropped.mT @ dropped / 32).mean(0)
    off = joint[~torch.eye(8, dtype=torch.bool)]
    assert (off - 1 / 16).abs().max() < 0.004  # of 4000 x 32 pairs, four standard deviations


def test_any_two_members_lose_a_unit_together_as_often_as_others():
    dropped = (balanced_bytes((4000,), 30, 8) < 64).double()
    together = (dropped[:, :1] * dropped[:, 1:]).mean((0, 2))
    assert (together - 49 / 870).abs().max() < 0.03  # of 30 members 7 or 8; there are 256 orders
