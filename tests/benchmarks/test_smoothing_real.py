"""The study behind trained sensors: its Gaussian model is the library's filter, its weights are least squares."""

import pytest
import torch
from torch.testing import assert_close

from benchmarks.smoothing import gaussian, linear, real
from benchmarks.smoothing.gaussian import Series


def series_for_tests(target=True, count=3, steps=14):
    """Two quantities that follow targets, or walk; a reading with a slow error; the first frame is not read."""
    truth = torch.randn(count, steps, 2).cumsum(1)
    reading = truth + 0.5 * torch.randn(count, 1, 2) + 0.3 * torch.randn(count, steps, 2)
    observed = torch.rand(count, steps, 1) < 0.8
    observed[:, 0], observed[:, 1] = False, True
    return Series(truth, reading, observed, truth + 0.1 if target else None)


def parameters_for_tests():
    names = ("walk", "change", "keeps_change", "error", "keeps_error", "white", "share")
    return {name: 0.5 * torch.randn(2) for name in names}


@pytest.mark.parametrize("target", [False, True])
def test_the_fitted_model_is_the_library_filter_and_smoother(float64, target):
    series = series_for_tests(target)
    model = gaussian.model_of(parameters_for_tests(), [series])
    before, after = gaussian.believe(model, series, real.LAG)
    own = real.kalman(model, series)
    for mean, square in zip((before, after), own, strict=True):
        assert_close(real.mean_square(mean, series.truth), square, rtol=1e-7, atol=1e-9)


def test_weights_find_what_only_later_readings_say(float64):
    reading = torch.randn(4, 60, 2)
    truth = torch.zeros_like(reading)
    truth[:, :-3] = 2 * reading[:, 3:] + 1  # the reading of three steps later
    series = Series(truth, reading, torch.ones(4, 60, 1, dtype=torch.bool), None)
    found = linear.weights([series], real.LAG)
    expected = torch.zeros_like(found)
    expected[:, linear.BACK + 3], expected[:, -1] = 2, 1
    assert_close(found, expected, rtol=0, atol=1e-5)
    assert real.mean_square(linear.estimates(series, found, real.LAG), truth).max() < 1e-8
    past = linear.estimates(series, linear.weights([series], 0), 0)
    assert real.mean_square(past, truth).min() > 2, "no weights of earlier readings can know it"
