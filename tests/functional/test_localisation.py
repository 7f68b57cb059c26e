"""Oracles: the published taper's values, the global transform, the Kalman update of each component by itself."""

import math

import pytest
import torch

from tests.functional.checks import assert_raises
from torch_denkf.functional import analyse, kalman_update, letkf, neighbours
from torch_denkf.functional.localisation import Neighbours, gaspari_cohn, neighbours_of_taper
from torch_denkf.functional.moments import ensemble_cov

EXACT = {"rtol": 1e-8, "atol": 1e-8}


def problem(size, dim, count, batch=(), seed=0):
    generator = torch.Generator().manual_seed(seed)

    def randn(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    forecast = 1 + randn(size, dim)
    return forecast, forecast[..., :count] + 0.1 * randn(size, count), randn(count), 0.2 + randn(count).square()


def everywhere(dim, count, taper=1.0):
    index = torch.arange(count).expand(dim, count)
    return Neighbours(index, torch.full((dim, count), taper, dtype=torch.float64))


def test_taper_at_the_knots_and_its_curvature():
    c = math.sqrt(10 / 3) * 3.0
    at = torch.tensor([0.0, c / 2, c, 1.5 * c, 2 * c, 5 * c], dtype=torch.float64)
    # eq. 4.10, the fractions written out
    half = -1 / 128 + 1 / 32 + 5 / 64 - 5 / 12 + 1
    beyond = 7.59375 / 12 - 5.0625 / 2 + 5 * 3.375 / 8 + 5 * 2.25 / 3 - 7.5 + 4 - 4 / 9
    expected = torch.tensor([1.0, half, 5 / 24, beyond, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(gaspari_cohn(at, 3.0), expected, rtol=0, atol=1e-12)
    small = torch.tensor(1e-2, dtype=torch.float64)  # 1 - d^2 / (2 radius^2), as a Gaussian
    torch.testing.assert_close(1 - gaspari_cohn(small, 3.0), small**2 / 18, rtol=2e-3, atol=0)


@pytest.mark.parametrize("batch", [(), (2, 3)])
@pytest.mark.parametrize("sizes", [(6, 5, 3), (5, 4, 4)])
@pytest.mark.parametrize("tile", [1, 2, 4096])
def test_full_neighbourhoods_equal_the_global_transform(batch, sizes, tile):
    parts = problem(*sizes, batch)
    expected = analyse(*parts, scheme="etkf").ensemble
    torch.testing.assert_close(letkf(*parts, everywhere(sizes[1], sizes[2]), tile=tile), expected, **EXACT)


def test_a_taper_divides_the_precision():
    forecast, predicted, observation, noise = problem(6, 4, 2)
    found = letkf(forecast, predicted, observation, noise, everywhere(4, 2, taper=0.25))
    torch.testing.assert_close(
        found, analyse(forecast, predicted, observation, 4 * noise, scheme="etkf").ensemble, **EXACT
    )


def test_each_component_alone_is_its_own_kalman_update():
    """A radius below the spacing: no component learns from another's observation, whatever the samples say."""
    forecast, _, observation, noise = problem(5, 7, 7)
    places = torch.arange(7, dtype=torch.float64).unsqueeze(-1)
    found = letkf(forecast, forecast, observation, noise, neighbours(places, places, 0.2))
    variance = forecast.var(-2)
    expected = kalman_update(forecast.mean(-2), variance.diag_embed(), observation, torch.eye(7).double(), noise)
    torch.testing.assert_close(found.mean(-2), expected.mean, **EXACT)
    torch.testing.assert_close(ensemble_cov(found).diagonal(), expected.cov.diagonal(), **EXACT)


def test_missing_observations_have_no_effect():
    forecast, predicted, observation, noise = problem(6, 5, 3)
    mask = torch.tensor([True, False, True])
    broken = torch.where(mask, observation, torch.nan), torch.where(mask, noise, torch.nan)
    found = letkf(forecast, predicted, *broken, everywhere(5, 3), observed=mask)
    expected = analyse(forecast, predicted, *broken, scheme="etkf", observed=mask).ensemble
    torch.testing.assert_close(found, expected, **EXACT)
    blind = letkf(forecast, predicted, *broken, everywhere(5, 3), observed=torch.tensor([False]))
    torch.testing.assert_close(blind, forecast, **EXACT)


def test_gradients_equal_finite_differences():
    parts = [value.requires_grad_() for value in problem(4, 3, 2)]
    near = everywhere(3, 2, taper=0.5)
    assert torch.autograd.gradcheck(lambda *parts: letkf(*parts, near, tile=2), parts)


def test_neighbours_of_a_taper_are_its_positive_entries():
    taper = torch.tensor([[0.0, 0.3, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0], [0.2, 0.4, 0.1, 0.0]])
    found = neighbours_of_taper(taper, tile=2)
    torch.testing.assert_close(torch.zeros(3, 4).scatter_add_(1, found.index, found.taper), taper)
    assert found.index.shape == (3, 3)
    assert_raises(ValueError, r"\[S, O\]", neighbours_of_taper, taper[0])


@pytest.mark.parametrize("period", [None, (10.0, math.inf), (10.0, 7.0)])
@pytest.mark.parametrize(("tile", "pairs"), [(16, 40), (1000, 2**24)])
def test_neighbours_on_a_plane_are_those_of_all_pairs(monkeypatch, period, tile, pairs):
    monkeypatch.setattr("torch_denkf.functional.localisation._PAIRS", pairs)
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([10.0, 7.0], dtype=torch.float64)
    states, observations = (size * torch.rand(n, 2, generator=generator, dtype=torch.float64) for n in (300, 90))
    period = None if period is None else torch.tensor(period, dtype=torch.float64)
    found = neighbours(states, observations, 0.3, period=period, tile=tile)
    offset = (states[:, None] - observations).abs()
    if period is not None:
        offset = torch.minimum(offset, period - offset)
    expected = gaspari_cohn(offset.square().sum(-1).sqrt(), 0.3)
    dense = torch.zeros_like(expected).scatter_add_(1, found.index, found.taper)
    torch.testing.assert_close(dense, expected, rtol=0, atol=1e-15)
    assert found.index.shape[1] == int((expected > 0).sum(1).max())
    assert int((expected > 0).sum(1).min()) == 0  # some see nothing
