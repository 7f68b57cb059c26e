"""Oracles: uniform histograms under the right distribution, SciPy's normal and binomial, counts by hand."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from tests.functional.checks import assert_raises
from torch_denkf.functional import wrap_angles
from torch_denkf.functional.manifolds import Circle, Euclidean
from torch_denkf.metrics import pit, spread_skill_ratio
from torch_denkf.metrics.calibration import ensemble_interval
from torch_denkf.plots.histograms import histogram_band, rank_histogram, spread_error


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def test_pit_is_the_normal_distribution_function():
    error = torch.linspace(-4, 4, 41, dtype=torch.float64).unsqueeze(-1)
    got = pit(torch.full_like(error, 2.0), torch.full_like(error, 9.0), 2 + 3 * error)
    np.testing.assert_allclose(got.numpy(), stats.norm.cdf(error.numpy()), rtol=1e-12)


def test_pit_of_no_spread():
    mean = torch.zeros(3, 1)
    assert pit(mean, mean, torch.tensor([[-1.0], [0.0], [1.0]])).flatten().tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize("members", [1, 9, 32])
def test_ranks_are_uniform_for_a_skewed_calibrated_ensemble(members):
    n = 40_000
    draws = torch.empty(n, members + 1, 2, dtype=torch.float64).exponential_(generator=rng())
    counts = rank_histogram(draws[:, :-1], draws[:, -1])
    assert counts.shape == (2, members + 1)
    assert counts.sum(1).tolist() == [n, n]
    low, high = histogram_band(n, members + 1, level=0.9999)  # six histograms
    assert bool(((low <= counts) & (counts <= high)).all())
    assert stats.chisquare(counts[0].numpy()).pvalue > 0.001


def test_ranks_by_hand_with_ties():
    members = torch.tensor([[[2.0], [1.0], [2.0]]]).expand(3, 3, 1)
    counts = rank_histogram(members, torch.tensor([[2.0], [0.0], [9.0]]))
    # A truth between two equal members: a third in each of the three gaps that they bound.
    np.testing.assert_allclose(counts.numpy(), [[1.0, 1 / 3, 1 / 3, 1 + 1 / 3]], atol=1e-12)


@pytest.mark.parametrize("space", [None, Circle() * Euclidean(1)])
def test_a_particle_counts_as_often_as_its_weight_says(space):
    draw = rng()
    members, truth = (torch.randn(500, *shape, generator=draw, dtype=torch.float64) for shape in ((6, 2), (2,)))
    members[:100, 3], members[100:150, 0] = truth[:100], truth[100:150]  # ties
    often = torch.tensor([3, 1, 0, 2, 0, 0])
    repeated = members.repeat_interleave(often, 1)
    weights = (often / 6).log().expand(500, 6)
    if space is not None:
        for part in (members, repeated, truth):
            part[..., 0] = wrap_angles(part[..., 0] + 3)
    counts = rank_histogram(members, truth, log_weight=weights, space=space)
    torch.testing.assert_close(counts, rank_histogram(repeated, truth, space=space))
    torch.testing.assert_close(counts, rank_histogram(members, truth, log_weight=weights + 7, space=space))
    # Equal weights are none.
    equal = rank_histogram(members, truth, log_weight=torch.zeros(500, 6), space=space)
    torch.testing.assert_close(equal, rank_histogram(members, truth, space=space))


def test_a_truth_between_two_ranks_counts_in_both():
    members = torch.tensor([[[0.0], [1.0], [2.0]]])
    weight = torch.tensor([[0.5, 0.3, 0.2]]).log()
    counts = rank_histogram(members, torch.tensor([[0.5]]), log_weight=weight)  # 1.5 of three members lie below
    torch.testing.assert_close(counts, torch.tensor([[0.0, 0.5, 0.5, 0.0]], dtype=torch.float64))
    assert_raises(
        ValueError,
        r"log_weight must be \[\*B, E\], \[1, 3\]",
        rank_histogram,
        members,
        torch.ones(1, 1),
        log_weight=weight[0],
    )


@pytest.mark.parametrize(("samples", "bins"), [(30, 5), (1000, 20), (5000, 33), (200_000, 10)])
def test_band_is_the_binomial_one(samples, bins):
    low, high = histogram_band(samples, bins)
    tail, law = 0.01 / bins / 2, stats.binom(samples, 1 / bins)
    assert law.cdf(low - 1) <= tail < law.cdf(low)
    assert law.sf(high) <= tail < law.sf(high - 1)


def test_band_holds_all_bars_of_calibrated_histograms_together():
    low, high = histogram_band(500, 20)
    counts = np.random.default_rng(0).multinomial(500, [1 / 20] * 20, size=4000)
    share = ((low <= counts) & (counts <= high)).all(1).mean()
    assert 0.988 <= share <= 1
    assert histogram_band(7, 1) == (7, 7)


def test_spread_error_by_hand_and_against_the_ratio():
    error = torch.randn(600, 2, generator=rng(), dtype=torch.float64)
    std = torch.rand(600, 2, generator=rng(1), dtype=torch.float64) + 0.5
    truth = torch.zeros_like(std)
    got = spread_error(error * std, std.square(), truth, bins=6, ensemble_size=4)
    for dim in range(2):
        order = std[:, dim].argsort().chunk(6)
        for part, spread, rmse in zip(order, got.spread[dim], got.error[dim], strict=True):
            assert spread.item() == pytest.approx(math.sqrt(1.25 * std[part, dim].square().mean().item()))
            assert rmse.item() == pytest.approx((error * std)[part, dim].square().mean().sqrt().item())
    whole = spread_error(error * std, std.square(), truth, bins=1, ensemble_size=4)
    ratio = spread_skill_ratio(error * std, std.square(), truth, 4)
    torch.testing.assert_close(whole.spread[:, 0] / whole.error[:, 0], ratio)


@pytest.mark.parametrize("level", [0.3, 0.8, 0.9])
def test_interval_is_numpys_quantile(level):
    ensemble = torch.randn(5, 23, 2, generator=rng(), dtype=torch.float64)
    low, high = ensemble_interval(ensemble, level=level)
    expected = np.quantile(ensemble.numpy(), [(1 - level) / 2, (1 + level) / 2], axis=1, method="weibull")
    np.testing.assert_allclose([low.numpy(), high.numpy()], expected, atol=1e-12)


def test_invalid_input_raises():
    ones = torch.ones(4, 2)
    assert_raises(ValueError, "cannot be negative", pit, ones, -ones, ones)
    assert_raises(ValueError, "must be finite", rank_histogram, torch.full((4, 3, 2), torch.nan), ones)
    assert_raises(ValueError, r"ensemble must be \[\*B, E, S\]", rank_histogram, ones, ones)
    assert_raises(ValueError, "needs samples and bins", histogram_band, 0, 10)
    assert_raises(ValueError, "5 bins need at least one state each; got 4", spread_error, ones, ones, ones, bins=5)
