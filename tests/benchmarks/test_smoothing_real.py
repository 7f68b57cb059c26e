"""The study behind trained sensors: its Gaussian model is the library's filter."""

import pytest
import torch
from torch.testing import assert_close

from benchmarks.smoothing import gaussian, real
from benchmarks.smoothing.gaussian import Series


def series_for_tests(target=True, count=3, steps=14):
    """Returns two quantities that follow targets, or walk; a reading with a slow error; the first frame is not read."""
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
