"""Oracles: the definitions, by moments, and the orthogonal group's own moments."""

import pytest
import torch

from torch_denkf.functional import ensemble_mean, ensemble_var
from torch_denkf.functional.inflation import inflate, random_rotation, relax_to_prior_spread
from torch_denkf.functional.moments import ensemble_cov

# Few operations on numbers of size 1 in double precision.
EXACT = {"rtol": 1e-12, "atol": 1e-12}


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("factor", [0.5, 1.06, torch.tensor([1.1, 1.2, 1.3])])
def test_inflation_scales_the_standard_deviation_and_keeps_the_mean(batch, factor):
    ensemble = randn(*batch, 6, 3)
    inflated = inflate(ensemble, factor)
    torch.testing.assert_close(ensemble_mean(inflated), ensemble_mean(ensemble), **EXACT)
    torch.testing.assert_close(ensemble_var(inflated), ensemble_var(ensemble) * torch.as_tensor(factor) ** 2)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("relaxation", [0.0, 0.3, 1.0])
def test_relaxed_spread_is_the_mixture_of_both(batch, relaxation):
    analysis, forecast = randn(*batch, 6, 3), 2 * randn(*batch, 6, 3, seed=1)
    relaxed = relax_to_prior_spread(analysis, forecast, relaxation)
    expected = (1 - relaxation) * ensemble_var(analysis).sqrt() + relaxation * ensemble_var(forecast).sqrt()
    torch.testing.assert_close(ensemble_var(relaxed).sqrt(), expected, **EXACT)
    torch.testing.assert_close(ensemble_mean(relaxed), ensemble_mean(analysis), **EXACT)


def test_relaxation_has_finite_gradients_without_spread():
    analysis, forecast = randn(4, 3), randn(4, 3, seed=1)
    analysis[:, 0], forecast[:, 1] = 1.0, 1.0
    analysis[:, 2], forecast[:, 2] = 1.0, 1.0
    relaxed = relax_to_prior_spread(analysis.requires_grad_(), forecast.requires_grad_(), 0.5)
    torch.testing.assert_close(relaxed[:, 0], analysis[:, 0])
    gradients = torch.autograd.grad(relaxed.square().sum(), (analysis, forecast))
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_relaxation_gradients_equal_finite_differences():
    inputs = randn(4, 3).requires_grad_(), randn(4, 3, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda a, f: relax_to_prior_spread(a, f, 0.4), inputs)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("size", [2, 3, 24])
def test_rotation_keeps_mean_and_covariance(size, batch):
    generator = torch.Generator().manual_seed(0)
    rotation = random_rotation(size, batch, generator=generator, dtype=torch.float64)
    identity = torch.eye(size, dtype=torch.float64).expand(*batch, size, size)
    torch.testing.assert_close(rotation @ rotation.mT, identity, **EXACT)
    ensemble = randn(*batch, size, 5)
    torch.testing.assert_close(ensemble_mean(rotation @ ensemble), ensemble_mean(ensemble), **EXACT)
    torch.testing.assert_close(ensemble_cov(rotation @ ensemble), ensemble_cov(ensemble), **EXACT)


def test_rotations_are_uniform():
    # Haar on O(n): the mean is 0 and each squared entry has mean 1 / n; here n = E - 1 = 3 of E = 4, so
    # the mean is 11ᵀ/E and an entry's variance is (E - 1) / E². Over 20,000 draws standard errors are
    # about 0.003 and 0.002; five of each for the 16 entries.
    rotation = random_rotation(4, (20_000,), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert (rotation.mean(0) - 1 / 4).abs().max() < 0.016
    assert (rotation.var(0) - 3 / 16).abs().max() < 0.01
    assert abs((torch.linalg.det(rotation) > 0).double().mean() - 0.5) < 0.02
