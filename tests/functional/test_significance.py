"""Localisation by significance: what chance alone explains moves nothing."""

import math

import pytest
import torch

from torch_denkf.functional import analyse
from torch_denkf.functional.analysis import significant

SCHEMES = ("sensor", "perturbed", "etkf", "sakov")


@pytest.fixture
def cases(float64):
    torch.manual_seed(0)
    forecast = torch.randn(3, 24, 5)
    predicted = forecast[..., :2] + 0.1 * torch.randn(3, 24, 2)
    return forecast, predicted, predicted.mean(-2) + 1.0, torch.tensor([0.3, 0.6]).expand(3, 2)


def by_hand(forecast, predicted, threshold):
    """1 - (z0 / z)^2 from torch's own correlation coefficients, one pair after the other."""
    size, factors = forecast.shape[-2], torch.zeros(*forecast.shape[:-2], predicted.shape[-1], forecast.shape[-1])
    for b in range(forecast.shape[0]):
        for o in range(predicted.shape[-1]):
            for s in range(forecast.shape[-1]):
                r = torch.corrcoef(torch.stack([predicted[b, :, o], forecast[b, :, s]]))[0, 1]
                factors[b, o, s] = max(0.0, 1 - threshold**2 / (float(r) ** 2 * (size - 1)))
    return factors


@pytest.mark.parametrize("threshold", [0.5, 1.5, 3.0])
def test_the_factors_are_those_of_the_correlations(cases, threshold):
    forecast, predicted, _, _ = cases
    state, seen = forecast - forecast.mean(-2, keepdim=True), predicted - predicted.mean(-2, keepdim=True)
    factors = significant(seen.mT @ state, seen, state, threshold)
    torch.testing.assert_close(factors, by_hand(forecast, predicted, threshold), rtol=0, atol=1e-12)
    scaled = significant(3.0 * seen.mT @ state * 7.0, 3.0 * seen, 7.0 * state, threshold)
    torch.testing.assert_close(scaled, factors, rtol=0, atol=1e-12)  # units do not matter


@pytest.mark.parametrize("scheme", ["perturbed", "sakov"])
def test_the_gain_is_multiplied_by_the_factors(cases, scheme):
    """As a taper of the same factors, which other tests hold."""
    forecast, predicted, reading, noise = cases
    draws = torch.randn_like(predicted) if scheme == "perturbed" else None
    taper = by_hand(forecast, predicted, 1.5).mT, torch.ones(2, 2)
    expected = analyse(forecast, predicted, reading, noise, scheme=scheme, perturbation=draws, taper=taper)
    result = analyse(forecast, predicted, reading, noise, scheme=scheme, perturbation=draws, significance=1.5)
    for one, other in zip(result, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-10)


def test_a_square_root_update_by_one_reading_is_the_serial_one_with_a_smaller_gain(cases):
    """Anderson's serial form: each component moves by its regression on the observed one, times the factor."""
    forecast, predicted, reading, noise = (value[..., :1] if k else value for k, value in enumerate(cases))
    factors = by_hand(forecast, predicted, 2.0)  # [B, 1, S]
    size = forecast.shape[-2]
    seen, state = predicted - predicted.mean(-2, keepdim=True), forecast - forecast.mean(-2, keepdim=True)
    variance = seen.square().sum(-2, keepdim=True) / (size - 1)
    slope = factors * (seen.mT @ state) / (size - 1) / variance
    share = variance / (variance + noise.unsqueeze(-2))
    shrunk = (noise.unsqueeze(-2) / (variance + noise.unsqueeze(-2))).sqrt()
    move = share * (reading.unsqueeze(-2) - predicted.mean(-2, keepdim=True)) + (shrunk - 1) * seen
    result = analyse(forecast, predicted, reading, noise, scheme="etkf", significance=2.0)
    torch.testing.assert_close(result.ensemble, forecast + move * slope, rtol=0, atol=1e-10)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_with_many_members_it_is_the_update_without(float64, scheme):
    torch.manual_seed(1)
    forecast = torch.randn(10_000, 2) @ torch.tensor([[1.0, 0.7], [0.0, 1.0]])
    predicted, noise = forecast[:, :1], torch.tensor([0.5])
    reading = 1.0 + 0.7 * torch.randn(10_000, 1) if scheme == "sensor" else torch.tensor([1.0])
    draws = torch.randn_like(predicted) if scheme == "perturbed" else None
    given = {"scheme": scheme, "perturbation": draws}
    plain = analyse(forecast, predicted, reading, noise, **given).ensemble
    limited = analyse(forecast, predicted, reading, noise, significance=3.0, **given).ensemble
    # 1 - (3 / z)^2 with z = |r| 100, and r of .57 at least: the gain is smaller by 0.3 % at most.
    move = (plain - forecast).norm(dim=0)
    assert ((plain - limited).norm(dim=0) < 0.003 * move).all()


def test_what_chance_explains_does_not_shrink(float64):
    """A component that no reading is about keeps its spread through a thousand updates; without, it is lost."""
    torch.manual_seed(2)
    ensembles = {None: torch.randn(32, 2), 3.0: torch.randn(32, 2)}
    for significance in ensembles:
        for _ in range(1000):
            ensemble = ensembles[significance]
            seen = 0.9 * ensemble[:, :1] + 0.44 * torch.randn(32, 1)  # it moves on
            ensemble = torch.cat([seen, ensemble[:, 1:]], -1)
            result = analyse(ensemble, seen, torch.zeros(1), torch.ones(1), scheme="etkf", significance=significance)
            ensembles[significance] = result.ensemble
    assert ensembles[None][:, 1].std() < 0.05
    assert ensembles[3.0][:, 1].std() > 0.7


def test_constant_components_and_hidden_readings_are_left_alone(cases):
    forecast, predicted, reading, noise = cases
    forecast = forecast.clone()
    forecast[..., 3] = 2.0
    hidden = torch.tensor([True, False]).expand(3, 2)
    broken = torch.where(hidden, reading, torch.nan)
    result = analyse(forecast, predicted, broken, noise, scheme="etkf", observed=hidden, significance=3.0)
    alone = analyse(forecast, predicted[..., :1], reading[..., :1], noise[..., :1], scheme="etkf", significance=3.0)
    torch.testing.assert_close(result.ensemble, alone.ensemble, rtol=0, atol=1e-12)
    assert (result.ensemble[..., 3] == 2.0).all()


def test_the_threshold_has_the_gradient_of_finite_differences(cases):
    forecast, predicted, reading, noise = cases
    threshold = torch.full((5,), 1.5, requires_grad=True)

    def means(threshold):
        return analyse(forecast, predicted, reading, noise, scheme="etkf", significance=threshold).ensemble.mean(-2)

    assert torch.autograd.gradcheck(means, threshold)
    assert math.isfinite(float(torch.autograd.grad(means(threshold).sum(), threshold)[0].sum()))


def test_ensemble_space_cannot(cases):
    with pytest.raises(ValueError, match="significance needs observation space"):
        analyse(*cases, scheme="etkf", significance=3.0, space="ensemble")
