"""Oracles: the scores' integrals and double sums, written out."""

import pytest
import torch

from torch_denkf.functional import crps_ensemble, crps_gaussian
from torch_denkf.functional.scores import energy_score

BATCHES = [(), (3,), (2, 3)]
# Sums of a few dozen numbers of size 1 in double precision.
EXACT = {"rtol": 1e-12, "atol": 1e-12}


def problem(batch=(), size=9, dim=4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    ensemble = torch.randn(*batch, size, dim, generator=generator, dtype=torch.float64)
    return ensemble, torch.randn(*batch, dim, generator=generator, dtype=torch.float64)


#: Each score, and the distance of two points that it is made of: of every component, or of all together.
SCORES = [(crps_ensemble, torch.abs), (energy_score, lambda offset: torch.linalg.vector_norm(offset, dim=-1))]


@pytest.mark.parametrize(("score", "distance"), SCORES)
@pytest.mark.parametrize("fair", [False, True])
@pytest.mark.parametrize("batch", BATCHES)
def test_a_score_is_the_double_sum(score, distance, batch, fair):
    ensemble, target = problem(batch)
    size, members = ensemble.shape[-2], len(batch)
    pairs = distance(ensemble.unsqueeze(-2) - ensemble.unsqueeze(-3)).sum((members, members + 1))
    expected = distance(ensemble - target.unsqueeze(-2)).mean(members)
    expected = expected - pairs / (2 * size * (size - 1 if fair else size))
    torch.testing.assert_close(score(ensemble, target, fair=fair), expected, **EXACT)


def test_crps_is_the_integral_of_the_squared_difference_of_distributions():
    ensemble, target = problem()
    grid = torch.linspace(-6, 6, 120_001, dtype=torch.float64)  # wider than all members
    distribution = (ensemble.unsqueeze(-1) <= grid).double().mean(0)
    step = (target.unsqueeze(-1) <= grid).double()
    integral = torch.trapezoid((distribution - step).square(), grid)
    # Each of the 10 jumps is misplaced by at most half a grid step, 5e-5, and counts at most once.
    torch.testing.assert_close(crps_ensemble(ensemble, target, fair=False), integral, rtol=0, atol=5e-4)


@pytest.mark.parametrize("score", [crps_ensemble, energy_score])
def test_fair_score_does_not_depend_on_the_ensemble_size(score):
    # 40,000 ensembles of 3 and of 20 from N(0, 1) against y = 0.7. For one component the expectation is
    # the Gaussian CRPS, y (2 Φ(y) - 1) + 2 φ(y) - 1 / sqrt(π) (Gneiting & Raftery 2007, eq. 21 ff.).
    y, normal = torch.tensor(0.7, dtype=torch.float64), torch.distributions.Normal(0, 1)
    expected = y * (2 * normal.cdf(y) - 1) + 2 * normal.log_prob(y).exp() - torch.pi**-0.5
    for size in (3, 20):
        ensemble, _ = problem((40_000,), size, 1)
        scores = score(ensemble, y.expand(40_000, 1))
        standard_error = scores.std().item() / 200
        assert abs(scores.mean().item() - expected.item()) < 3 * standard_error
        unfair = score(ensemble, y.expand(40_000, 1), fair=False).mean().item()
        # Counting the pairs i = j, whose distance is 0, costs 1/(2E) E|x - x'| = 1 / (E sqrt(π)).
        assert abs(unfair - expected.item() - 1 / size / torch.pi**0.5) < 3 * standard_error


@pytest.mark.parametrize("score", [crps_ensemble, energy_score])
def test_gradients(score):
    ensemble, target = problem((2,))
    assert torch.autograd.gradcheck(score, (ensemble.requires_grad_(), target.requires_grad_()))
    same = torch.ones(2, 3, 4, requires_grad=True)  # all members and the target at one point
    score(same, torch.ones(2, 4)).sum().backward()
    assert same.grad.isfinite().all()


@pytest.mark.parametrize("score", [crps_ensemble, energy_score])
def test_no_digits_are_lost_far_from_the_origin(score):
    ensemble, target = problem()
    # At 1e4 single precision resolves 1e-3, which the members are rounded to beforehand.
    shifted, shifted_target = (ensemble + 1e4).float(), (target + 1e4).float()
    expected = score(shifted.double(), shifted_target.double())
    torch.testing.assert_close(score(shifted, shifted_target), expected.float(), rtol=1e-5, atol=1e-6)


def test_crps_of_a_gaussian_is_the_integral_of_the_squared_difference_of_distributions():
    mean, variance = torch.tensor([[0.0, 1.0], [2.0, -1.0]]).double(), torch.tensor([[1.0, 0.25], [4.0, 0.01]]).double()
    target = torch.tensor([[0.3, -2.0], [2.0, -1.05]]).double()
    grid = torch.linspace(-30, 30, 600_001, dtype=torch.float64)
    normal = torch.distributions.Normal(mean.unsqueeze(-1), variance.sqrt().unsqueeze(-1))
    integral = torch.trapezoid((normal.cdf(grid) - (target.unsqueeze(-1) <= grid).double()).square(), grid)
    # The jump at the target is misplaced by at most half a grid step, 5e-5.
    torch.testing.assert_close(crps_gaussian(mean, variance, target), integral, rtol=0, atol=1e-4)
    members = mean.unsqueeze(-2) + variance.sqrt().unsqueeze(-2) * torch.randn(2, 100_000, 2).double()
    torch.testing.assert_close(crps_gaussian(mean, variance, target), crps_ensemble(members, target), rtol=0.02, atol=0)


def test_gradients_of_the_crps_of_a_gaussian():
    inputs = [torch.rand(3, 2, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    assert torch.autograd.gradcheck(lambda m, v, y: crps_gaussian(m, v + 0.1, y), inputs)
