"""Chi-square distributions against scipy's, run lengths against published ones and a simulation."""

import pytest
import torch
from scipy.stats import chi2, ncx2, norm

from torch_denkf.monitoring import detectable_bias
from torch_denkf.monitoring.change_detection import cusum_run_length, cusum_step, cusum_threshold, normal_score
from torch_denkf.monitoring.chi_square import chi_square_p_value, chi_square_quantile, noncentral_p_value


@pytest.mark.parametrize("freedom", [1, 2, 7, 40])
def test_chi_square_is_that_of_scipy(freedom):
    value = torch.tensor([1e-3, 0.5, 3.0, 20.0, 90.0], dtype=torch.float64)
    assert torch.allclose(chi_square_p_value(value, freedom), torch.from_numpy(chi2.sf(value.numpy(), freedom)))
    for p in (0.9, 0.05, 1e-6):
        assert chi_square_quantile(p, freedom) == pytest.approx(chi2.isf(p, freedom), rel=1e-8)


def test_without_freedom_nothing_is_unlikely_and_gradients_are_finite():
    value = torch.zeros(2, requires_grad=True)
    p = chi_square_p_value(value, torch.tensor([0.0, 1.0]))
    p.sum().backward()
    assert p.tolist() == [1.0, 1.0]
    assert value.grad.isfinite().all()


def test_the_slope_of_the_p_value_is_minus_the_density():
    value = torch.tensor([0.7, 4.0], dtype=torch.float64, requires_grad=True)
    chi_square_p_value(value, 3).sum().backward()
    assert torch.allclose(-value.grad, torch.from_numpy(chi2.pdf(value.detach().numpy(), 3)))


@pytest.mark.parametrize(("freedom", "noncentrality"), [(1, 0.0), (2, 0.3), (5, 12.0), (20, 400.0)])
def test_noncentral_is_that_of_scipy(freedom, noncentrality):
    for value in (0.5, 10.0, 60.0, 420.0):
        expected = ncx2.sf(value, freedom, noncentrality) if noncentrality else chi2.sf(value, freedom)
        assert noncentral_p_value(value, freedom, noncentrality) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize(("freedom", "window"), [(1, 1), (3, 1), (2, 10), (10, 25)])
def test_the_detectable_bias_has_its_power(freedom, window):
    bias = detectable_bias(freedom, 1e-3, power=0.9, window=window)
    limit = chi2.isf(1e-3, freedom * window)
    assert ncx2.sf(limit, freedom * window, window * bias**2) == pytest.approx(0.9, abs=1e-8)


@pytest.mark.parametrize(
    ("threshold", "shift", "published"),
    # Montgomery, Introduction to Statistical Quality Control, table 9.3 (two-sided, k = 1/2); without a shift one side
    # gives an alarm half as often.
    [(4, 0.0, 168), (5, 0.0, 465), (4, 1.0, 8.38), (5, 1.0, 10.4), (4, 2.0, 3.34), (5, 2.0, 4.01), (5, 3.0, 2.57)],
)
def test_run_lengths_are_the_published_ones(threshold, shift, published):
    found = cusum_run_length(threshold, 0.5, shift)
    assert (found / 2 if shift == 0 else found) == pytest.approx(published, rel=0.005)


def test_simulated_run_lengths_fit():
    torch.manual_seed(0)
    threshold, runs = 3.0, 4000
    total, length = torch.zeros(runs), torch.zeros(runs)
    alive = torch.ones(runs, dtype=torch.bool)
    while alive.any():
        length += alive
        total = cusum_step(total, torch.randn(runs), 0.5)
        alive &= total <= threshold
    expected = cusum_run_length(threshold)  # 117.6; run lengths are nearly exponential
    assert abs(length.mean().item() - expected) < 4 * expected / runs**0.5


def test_threshold_is_the_inverse_of_the_run_length():
    assert cusum_run_length(cusum_threshold(1000.0, 0.7), 0.7) == pytest.approx(1000, rel=1e-6)
    with pytest.raises(ValueError, match="raise the reference"):
        cusum_threshold(1e40)


def test_scores_are_normal_quantiles_within_bounds():
    p = torch.tensor([0.999, 0.3, 1e-3, 0.0, 1.0], dtype=torch.float64, requires_grad=True)
    score = normal_score(p, 3.5)
    assert score[:3].tolist() == pytest.approx(norm.isf([0.999, 0.3, 1e-3]).tolist(), rel=1e-6)
    assert score[3:].tolist() == pytest.approx([3.5, -3.5], rel=1e-6)
    score.sum().backward()
    assert p.grad.isfinite().all()
