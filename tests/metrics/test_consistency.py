"""Oracles: SciPy's distributions, and draws from a known Gaussian."""

import pytest
import torch
from scipy import stats

from tests.functional.checks import assert_raises
from torch_denkf.metrics import nees
from torch_denkf.metrics.consistency import _chi_square_quantile


def gaussians(count=5, dims=3, seed=0):
    rng = torch.Generator().manual_seed(seed)
    factor = torch.randn(count, dims, dims, generator=rng, dtype=torch.float64)
    mean, truth = torch.randn(2, count, dims, generator=rng, dtype=torch.float64)
    return mean, factor @ factor.mT + 0.1 * torch.eye(dims).double(), truth


def test_nees_by_inverse():
    mean, covariance, truth = gaussians()
    error = mean - truth
    expected = torch.einsum("bi,bij,bj->b", error, torch.linalg.inv(covariance), error)
    result = nees(mean, covariance, truth)
    torch.testing.assert_close(result.values, expected)
    torch.testing.assert_close(result.mean, expected.mean())
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(nees(mean, variance, truth).values, (error.square() / variance).sum(-1))


@pytest.mark.parametrize("freedom", [1, 2, 5, 37, 600, 20_000, 3_000_000])
@pytest.mark.parametrize("p", [0.005, 0.025, 0.5, 0.975, 0.9995])
def test_quantiles_are_those_of_scipy(p, freedom):
    assert _chi_square_quantile(p, freedom) == pytest.approx(stats.chi2.ppf(p, freedom), rel=1e-9)


def test_bounds_hold_for_a_consistent_belief_and_tell_others():
    runs, steps, dims = 50, 400, 3
    _, covariance, _ = gaussians(1, dims)
    rng = torch.Generator().manual_seed(1)
    error = torch.randn(runs, steps, dims, generator=rng, dtype=torch.float64) @ torch.linalg.cholesky(covariance[0]).mT
    covariance, zero = covariance[0].expand(runs, steps, dims, dims), torch.zeros_like(error)
    result = nees(zero, covariance, error, dim=0, level=0.9)
    assert result.mean.shape == (steps,)
    assert (result.lower, result.upper) == pytest.approx(
        (stats.chi2.ppf(0.05, runs * dims) / runs, stats.chi2.ppf(0.95, runs * dims) / runs)
    )
    inside = ((result.lower <= result.mean) & (result.mean <= result.upper)).double().mean()
    assert abs(inside - 0.9) < 5 * (0.9 * 0.1 / steps) ** 0.5
    over = nees(zero, 0.8 * covariance, error)
    assert over.mean > over.upper
    under = nees(zero, 1.25 * covariance, error)
    assert under.mean < under.lower
    exact = nees(zero, covariance, error)
    assert exact.lower < exact.mean < exact.upper


def test_sample_covariances_give_the_mean_of_the_docstring():
    count, members, dims = 20_000, 20, 2
    rng = torch.Generator().manual_seed(0)
    draws = torch.randn(count, members + 1, dims, generator=rng, dtype=torch.float64)
    ensemble, truth = draws[:, :members], draws[:, members]
    centred = ensemble - ensemble.mean(1, keepdim=True)
    values = nees(ensemble.mean(1), centred.mT @ centred / (members - 1), truth).values
    expected = dims * (members + 1) * (members - 1) / (members * (members - dims - 2))
    assert abs(values.mean() - expected) < 5 * values.std() / count**0.5
    assert expected > 1.2 * dims  # the plain S would be far off


def test_invalid_input_raises():
    mean = torch.zeros(4, 3)
    assert_raises(ValueError, r"\[4, 3, 3\], or variances .* got \[3, 3\]", nees, mean, torch.eye(3), mean)
    few = torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(0))[:, :2]
    with pytest.raises(
        ValueError, match="4 of 4 covariances are not positive definite; an ensemble needs more than S = 3"
    ):
        nees(mean, few.mT @ few - 1e-3 * torch.eye(3), mean)
    with pytest.raises(ValueError, match="variances must be positive; the least is 0"):
        nees(mean, torch.zeros(4, 3), mean)
    assert_raises(ValueError, r"in \(0, 1\); got 95", nees, mean, torch.ones(4, 3), mean, level=95)
    assert_raises(ValueError, "no errors", nees, mean[:0], mean[:0], mean[:0])
