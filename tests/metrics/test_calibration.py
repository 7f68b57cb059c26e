"""Oracles: counts by hand, binomial shares of known distributions, NumPy's quantiles."""

import pytest
import torch

from tests.functional.checks import assert_raises
from torch_denkf.metrics import ensemble_interval_coverage, interval_coverage


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def test_gaussian_interval_by_hand():
    # 1.6449 standard deviations: 3.2897 at variance 4.
    truth = torch.tensor([[[1.6448, 3.2896], [1.6450, -3.2898]]])
    mean, variance = torch.zeros(1, 2, 2), torch.tensor([1.0, 4.0]).expand(1, 2, 2)
    assert interval_coverage(mean, variance, truth).tolist() == [0.5, 0.5]
    assert interval_coverage(mean, 1.001 * variance, truth).tolist() == [1.0, 1.0]
    assert interval_coverage(mean, 0.999 * variance, truth).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
def test_gaussian_interval_of_a_calibrated_belief(level):
    n = 40_000
    scale = torch.tensor([0.1, 3.0])
    truth = 5 + scale * torch.randn(n, 2, generator=rng())
    share = interval_coverage(torch.full((n, 2), 5.0), scale.square().expand(n, 2), truth, level=level)
    assert ((share - level).abs() < 5 * (level * (1 - level) / n) ** 0.5).all()


@pytest.mark.parametrize(("members", "level"), [(19, 0.9), (32, 0.9), (9, 0.8), (40, 0.5)])
def test_ensemble_interval_of_a_calibrated_ensemble(members, level):
    n = 40_000
    draws = torch.distributions.Exponential(1.0)  # skewed: no Gaussian interval fits
    ensemble, truth = draws.sample((n, members, 1)), draws.sample((n, 1))
    share = ensemble_interval_coverage(ensemble, truth, level=level).item()
    # Ranks that are whole numbers make it exact: (19 + 1) x 0.05 = 1, (9 + 1) x 0.1 = 1. Others interpolate.
    exact = (1 - level) / 2 * (members + 1)
    slack = 0.0 if abs(exact - round(exact)) < 1e-9 else 0.005
    assert abs(share - level) < 5 * (level * (1 - level) / n) ** 0.5 + slack


def test_invalid_input_raises():
    mean = torch.zeros(4, 2)
    with pytest.raises(ValueError, match=r"18 members span 17/19 of their distribution; level 0\.9 needs more"):
        ensemble_interval_coverage(torch.zeros(4, 18, 2), mean)
    with pytest.raises(ValueError, match=r"ensemble must be \[\*B, E, S\]"):
        ensemble_interval_coverage(torch.zeros(4, 19, 3), mean)
    assert_raises(ValueError, "cannot be negative", interval_coverage, mean, mean - 1, mean)
    assert_raises(ValueError, r"shape of the mean, \[4, 2\]; got \[2\]", interval_coverage, mean, torch.ones(2), mean)
    assert_raises(ValueError, r"in \(0, 1\); got 90", interval_coverage, mean, torch.ones(4, 2), mean, level=90)
