"""Oracles: finite differences, and the orthogonal group's own moments."""

from functools import partial

import pytest
import torch

from torch_denkf.functional.inflation import random_rotation, relax_to_prior_spread
from torch_denkf.functional.moments import ensemble_cov, ensemble_mean

# Few operations on numbers of size 1 in double precision.
EXACT = {"rtol": 1e-12, "atol": 1e-12}


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


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


@pytest.fixture(params=["processor", "GPU"])
def rotations(request, as_on_a_gpu):
    """Returns the function that draws, by QR decompositions or by reflections as on a GPU."""
    options = {"generator": torch.Generator().manual_seed(0), "dtype": torch.float64}
    draw = random_rotation if request.param == "processor" else partial(as_on_a_gpu, random_rotation)
    return partial(draw, **options)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("size", [2, 3, 24])
def test_rotation_keeps_mean_and_covariance(rotations, size, batch):
    rotation = rotations(size, batch)
    identity = torch.eye(size, dtype=torch.float64).expand(*batch, size, size)
    torch.testing.assert_close(rotation @ rotation.mT, identity, **EXACT)
    ensemble = randn(*batch, size, 5)
    torch.testing.assert_close(ensemble_mean(rotation @ ensemble), ensemble_mean(ensemble), **EXACT)
    torch.testing.assert_close(ensemble_cov(rotation @ ensemble), ensemble_cov(ensemble), **EXACT)


def test_rotations_are_uniform(rotations):
    # Haar on O(n): the mean is 0 and each squared entry has mean 1 / n; here n = E - 1 = 3 of E = 4, so
    # the mean is 11ᵀ/E and an entry's variance is (E - 1) / E². Over 20,000 draws standard errors are
    # about 0.003 and 0.002; five of each for the 16 entries.
    rotation = rotations(4, (20_000,))
    assert (rotation.mean(0) - 1 / 4).abs().max() < 0.016
    assert (rotation.var(0) - 3 / 16).abs().max() < 0.01
    assert abs((torch.linalg.det(rotation) > 0).double().mean() - 0.5) < 0.02
    assert abs(rotation.diagonal(dim1=-2, dim2=-1).sum(-1).var() - 1) < 0.03  # that of a trace in three dimensions
