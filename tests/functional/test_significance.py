"""Localisation by significance: what chance alone explains moves nothing."""

import math

import pytest
import torch

from torch_denkf.functional import analyse, letkf
from torch_denkf.functional.analysis import significant
from torch_denkf.functional.localisation import Neighbours
from torch_denkf.modules import EnsembleAnalysis, LocalEnsembleAnalysis


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
                factors[b, o, s] = max(0.0, 1 - threshold**2 / (float(r.detach()) ** 2 * (size - 1)))
    return factors


@pytest.mark.parametrize("threshold", [0.5, 1.5, 3.0])
def test_the_factors_are_those_of_the_correlations(cases, threshold):
    forecast, predicted, _, _ = cases
    state, seen = forecast - forecast.mean(-2, keepdim=True), predicted - predicted.mean(-2, keepdim=True)
    factors = significant(seen.mT @ state, seen, state, threshold)
    torch.testing.assert_close(factors, by_hand(forecast, predicted, threshold), rtol=0, atol=1e-12)
    scaled = significant(3.0 * seen.mT @ state * 7.0, 3.0 * seen, 7.0 * state, threshold)
    torch.testing.assert_close(scaled, factors, rtol=0, atol=1e-12)  # units do not matter


@pytest.mark.parametrize("scheme", ["sensor", "perturbed", "sakov"])
@pytest.mark.parametrize("tapered", [False, True])
def test_readings_are_taken_in_one_after_the_other_with_smaller_gains(cases, scheme, tapered):
    """As updates by one reading each, tapered by the same factors; what the members predict is moved like the state."""
    forecast, predicted, reading, noise = cases
    forecast = forecast.clone().requires_grad_()
    if scheme == "sensor":
        reading = reading.unsqueeze(-2) + 0.5 * torch.randn_like(predicted)
    draws = torch.randn_like(predicted) if scheme == "perturbed" else None
    taper = (torch.rand(5, 2), torch.tensor([[1.0, 0.3], [0.3, 1.0]])) if tapered else None
    moved, scores = torch.cat([forecast, predicted], -1), 0.0
    for j in range(2):
        seen = moved[..., 5 + j : 6 + j]
        factors = by_hand(moved, seen, 1.5).mT
        if taper is not None:
            factors = factors * torch.cat([taper[0][:, j], taper[1][:, j]]).unsqueeze(-1)
        noises = None if draws is None else draws[..., j : j + 1]
        given = {"scheme": scheme, "perturbation": noises, "taper": (factors, torch.ones(1, 1))}
        result = analyse(moved, seen, reading[..., j : j + 1], noise[..., j : j + 1], **given)
        moved, scores = result.ensemble, scores + torch.cat([result.nis, result.log_likelihood], -1)
    options = {"scheme": scheme, "perturbation": draws, "taper": taper, "significance": 1.5}
    result = analyse(forecast, predicted, reading, noise, **options)
    torch.testing.assert_close(result.ensemble, moved[..., :5], rtol=0, atol=1e-10)
    torch.testing.assert_close(torch.cat([result.nis, result.log_likelihood], -1), scores, rtol=0, atol=1e-10)
    # The factors are constants for the members' gradient.
    slopes = [torch.autograd.grad(each.square().sum(), forecast)[0] for each in (result.ensemble, moved[..., :5])]
    torch.testing.assert_close(*slopes, rtol=0, atol=1e-9)


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


def test_constant_components_and_masked_readings_are_unchanged(cases):
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
    forecast, predicted, *parts = cases
    one = [predicted[..., :1], *(part[..., :1] for part in parts)]  # of several, the first moves what the second tells
    threshold = torch.full((5,), 1.5, requires_grad=True)

    def means(threshold):
        return analyse(forecast, *one, scheme="etkf", significance=threshold).ensemble.mean(-2)

    assert torch.autograd.gradcheck(means, threshold)
    assert math.isfinite(float(torch.autograd.grad(means(threshold).sum(), threshold)[0].sum()))


def test_a_local_analysis_weighs_by_the_factors(cases):
    """As its taper times the same factors, which have no gradient; finite differences of the threshold."""
    forecast, predicted, reading, noise = cases
    near = Neighbours(torch.arange(2).expand(5, 2), torch.tensor([[1.0, 0.4]]).expand(5, 2))
    found = letkf(forecast, predicted, reading, noise, near, significance=1.5, tile=2)
    factors = by_hand(forecast, predicted, 1.5)
    assert (factors == 0).any()
    for b in range(3):
        weighed = Neighbours(near.index, near.taper * factors[b].mT)
        members = forecast[b].clone().requires_grad_()
        given = members, members[:, :2] + predicted[b] - forecast[b, :, :2], reading[b], noise[b]
        expected, moved = letkf(*given, weighed), letkf(*given, near, significance=1.5)
        torch.testing.assert_close(found[b], expected, rtol=0, atol=1e-10)
        slopes = [torch.autograd.grad(each.square().sum(), members)[0] for each in (moved, expected)]
        torch.testing.assert_close(*slopes, rtol=0, atol=1e-9)

    def moved(threshold):
        return letkf(forecast[0], predicted[0], reading[0], noise[0], near, significance=threshold)

    assert torch.autograd.gradcheck(moved, torch.tensor(1.5, requires_grad=True))


def test_each_component_has_a_threshold_and_readings_have_their_mean(cases):
    forecast, predicted, reading, noise = cases
    thresholds, moved = torch.tensor([0.5, 1.0, 1.5, 2.0, 2.5]), torch.cat([forecast, predicted], -1)
    for j in range(2):
        seen = moved[..., 5 + j : 6 + j]
        columns = [by_hand(moved[..., k : k + 1], seen, float(limit)).mT for k, limit in enumerate(thresholds)]
        factors = torch.cat([*columns, by_hand(moved[..., 5:], seen, 1.5).mT], -2), torch.ones(1, 1)
        parts = reading[..., j : j + 1], noise[..., j : j + 1]
        moved = analyse(moved, seen, *parts, scheme="sakov", taper=factors).ensemble
    result = analyse(forecast, predicted, reading, noise, scheme="sakov", significance=thresholds).ensemble
    torch.testing.assert_close(result, moved[..., :5], rtol=0, atol=1e-10)


def test_clones_use_the_thresholds_of_the_state(cases):
    """A past that equals the present moves as the present does."""
    forecast, *given = cases
    thresholds = torch.tensor([0.5, 1.0, 1.5, 2.0, 2.5])
    analysis = EnsembleAnalysis("etkf", localisation="significance", threshold=thresholds)
    now = analysis.compute(forecast, *given, noise=None)[0]
    past = analysis.move_past(forecast.unsqueeze(-2).expand(-1, -1, 3, -1), *given)
    torch.testing.assert_close(past, now.unsqueeze(-2).expand_as(past), rtol=0, atol=1e-10)


def test_the_local_module_weighs_as_its_formula(cases):
    near = Neighbours(torch.arange(2).expand(5, 2), torch.ones(5, 2))
    forecast, *given = cases
    local = LocalEnsembleAnalysis(near, localisation="significance", threshold=1.5)
    expected = letkf(forecast, *given, near, significance=1.5)
    torch.testing.assert_close(local.compute(forecast, *given, noise=None)[0], expected, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="one number for all components"):
        LocalEnsembleAnalysis(near, localisation="significance", threshold=torch.ones(5))


def test_tiled_significance_equals_untiled(float64, monkeypatch):
    """More readings than members solve in ensemble space, so many states in tiles; with significance neither."""
    forecast, reading = torch.randn(5, 40), torch.randn(6)
    given = forecast, forecast[:, :6], reading, torch.ones(6)
    expected = analyse(*given, scheme="etkf", significance=1.5).ensemble
    monkeypatch.setattr("torch_denkf.functional.analysis.columns_in_a_tile", lambda *_: 8)
    torch.testing.assert_close(analyse(*given, scheme="etkf", significance=1.5).ensemble, expected, rtol=0, atol=0)
