"""Oracles: the Kalman filter that knows a system, the Riccati equation of its steady state, a closed form."""

import math

import pytest
import torch

from benchmarks.ur5.limits import LinearFilter, fit, regress, slopes
from benchmarks.ur5.memory import Memory

ERROR, CHANGE = torch.tensor([0.5, 2.0]), torch.tensor([0.01, 0.3])


def test_variances_settle_where_the_riccati_equation_has_them():
    filter = LinearFilter(3, 2, ERROR, CHANGE).double()
    with torch.no_grad():
        _, variance = filter(torch.zeros(1, 400, 2).double(), torch.zeros(1, 2).double(), torch.ones(2).double())
        move, noise = filter.matrices()
    read = torch.tensor([[1.0, 0.0, 0.0, 1.0, 1.0]]).double()
    for number in range(2):
        cov = torch.eye(5).double()
        white = float((2 * filter.log_reading[number]).exp().detach())
        for _ in range(4000):
            cov = move[number] @ cov @ move[number].mT + noise[number]
            gain = cov @ read.mT / (read @ cov @ read.mT + white)
            cov = cov - gain @ read @ cov
        torch.testing.assert_close(variance[0, -1, number], cov[0, 0], rtol=1e-3, atol=0)


@pytest.mark.slow
def test_a_fitted_filter_is_as_good_as_the_one_that_knows_the_system(monkeypatch):
    monkeypatch.setattr("benchmarks.ur5.limits.LENGTH", 60)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(2, 60, 120, 1, generator=generator)
    truth = (0.02 * drawn[0]).cumsum(1).cumsum(1)  # a rate that wanders
    readings = truth + 0.5 * drawn[1]
    known = LinearFilter(2, 0, torch.tensor([0.5 / 0.4]), torch.tensor([0.02]))  # R begins at 0.4 of the error
    known.damping.data.fill_(20.0)
    fitted = fit(2, 0, readings[:40], truth[:40], updates=60)
    start, std = truth[40:, 0], torch.full((1,), 0.05)
    memory = Memory(readings[:40], truth[:40], updates=120)
    with torch.no_grad():
        scores = []
        for filter in (known, fitted):
            mean, variance = filter(readings[40:], start, std)
            error = mean - truth[40:, 1:]
            scores.append(float(error.square().mean().sqrt()))
            assert 0.87 < (error.abs() < 1.645 * variance.sqrt()).float().mean() < 0.93
    assert scores[0] < 0.3  # of readings 0.5
    assert scores[1] < 1.05 * scores[0]
    with torch.no_grad():
        remembered = memory(readings[40:], start)[:, 1:] - truth[40:, 1:]
        assert remembered.square().mean().sqrt() < 1.3 * scores[0]
        later = readings[40:].clone()
        later[:, 60:] += 10.0
        torch.testing.assert_close(memory(later, start)[:, :60], memory(readings[40:], start)[:, :60])


def test_a_regression_on_one_reading_shrinks_it_as_the_closed_form_has_it():
    generator = torch.Generator().manual_seed(1)
    truth = torch.randn(50, 400, 1, generator=generator)
    readings = truth + torch.randn(truth.shape, generator=generator)
    said = regress((readings, truth), readings, 1, ridge=0.0)
    torch.testing.assert_close(said, 0.5 * readings, atol=0.03, rtol=0)  # 20,000 readings say the factor to 0.005
    assert math.isclose(float(slopes(readings, truth)), 1.0, abs_tol=0.03)
    assert math.isclose(float(slopes(torch.randn(truth.shape, generator=generator), truth)), 0.0, abs_tol=0.03)
