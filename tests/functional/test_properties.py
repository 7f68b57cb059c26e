"""Tests the mathematics for any shape, precision, scale, order of members and unit."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.properties_for_tests import BATCHES, DIMS, DTYPES, FIXED, MEMBERS, SCALES, SCHEMES, SEEDS, Draw, close
from torch_denkf.functional import (
    analyse,
    crps_ensemble,
    crps_gaussian,
    kalman_predict,
    kalman_update,
    sigma_points,
    transport_resample,
)
from torch_denkf.functional.gaussian import gaussian_log_prob
from torch_denkf.functional.inflation import inflate, relax_to_prior_spread
from torch_denkf.functional.moments import ensemble_cov, ensemble_mean, ensemble_var
from torch_denkf.functional.scores import energy_score
from torch_denkf.functional.unscented import unscented_moments, unscented_weights
from torch_denkf.functional.weighted import weighted_mean

SPACES = st.sampled_from(["observation", "ensemble"])


class Problem:
    """An analysis of random numbers."""

    def __init__(self, seed, batch, members, states, readings, dtype=torch.float64):
        draw = Draw(seed, dtype)
        self.draw = draw
        self.forecast = 2 + draw.normal(*batch, members, states)
        self.predicted = self.forecast @ draw.normal(*batch, readings, states).mT
        self.samples = draw.normal(*batch, members, readings)
        self.noise = 0.1 + draw.normal(*batch, readings).square()
        self.perturbation = draw.normal(*batch, members, readings)

    def analyse(self, scheme, **options):
        if scheme == "perturbed":
            options.setdefault("perturbation", self.perturbation)
        given = [options.pop(name, getattr(self, name)) for name in ("forecast", "predicted", "samples", "noise")]
        return analyse(*given, scheme=scheme, **options)


@FIXED
@given(SEEDS, BATCHES, MEMBERS, DIMS, DIMS, SCHEMES, SPACES)
def test_members_may_come_in_any_order(seed, batch, members, states, readings, scheme, space):
    problem = Problem(seed, batch, members, states, readings)
    order = problem.draw.order(members)
    names = ("forecast", "predicted", "samples", *(["perturbation"] if scheme == "perturbed" else []))
    shuffled = problem.analyse(scheme, space=space, **{name: getattr(problem, name)[..., order, :] for name in names})
    plain = problem.analyse(scheme, space=space)
    close(shuffled.ensemble, plain.ensemble[..., order, :])
    close(shuffled.nis, plain.nis)
    close(shuffled.log_likelihood, plain.log_likelihood)


@FIXED
@given(SEEDS, BATCHES, MEMBERS, DIMS, DIMS, SCHEMES, SPACES, SCALES, SCALES)
def test_an_analysis_in_other_units(seed, batch, members, states, readings, scheme, space, state_scale, scale):
    """States in other units, readings in others: the same result in these units."""
    problem = Problem(seed, batch, members, states, readings)
    a, b = problem.draw.units(state_scale, states), problem.draw.units(scale, readings)
    plain = problem.analyse(scheme, space=space)
    other = problem.analyse(
        scheme,
        space=space,
        forecast=problem.forecast * a,
        predicted=problem.predicted * b,
        samples=problem.samples * b,
        noise=problem.noise * b.square(),
    )
    close(other.ensemble / a, plain.ensemble)
    close(other.innovation / b, plain.innovation)
    close(other.nis, plain.nis)
    close(other.log_likelihood + b.log().sum(), plain.log_likelihood, atol=1e-7)


@FIXED
@given(SEEDS, BATCHES, MEMBERS, DIMS, st.integers(2, 6), SCHEMES, SPACES, st.sampled_from([math.nan, math.inf, 1e300]))
def test_missing_observation_equals_a_smaller_observation(seed, batch, members, states, readings, scheme, space, junk):
    problem = Problem(seed, batch, members, states, readings)
    seen = problem.draw.mask(readings)
    seen[0] = True
    hidden = {
        "samples": torch.where(seen, problem.samples, junk),
        "noise": torch.where(seen, problem.noise, junk),
        "observed": seen.expand(*batch, readings),
    }
    leaves = [hidden[name].requires_grad_() for name in ("samples", "noise")]
    masked = problem.analyse(scheme, space=space, **hidden)
    names = ("predicted", "samples", "perturbation") if scheme == "perturbed" else ("predicted", "samples")
    less = {name: getattr(problem, name)[..., seen] for name in (*names, "noise")}
    without = problem.analyse(scheme, space=space, **less)
    close(masked.ensemble, without.ensemble)
    close(masked.innovation[..., seen], without.innovation)
    assert (masked.innovation[..., ~seen] == 0).all()
    close(masked.nis, without.nis)
    close(masked.log_likelihood, without.log_likelihood)
    for gradient in torch.autograd.grad(sum(value.square().sum() for value in masked), leaves):
        assert gradient.isfinite().all()
        assert (gradient[..., ~seen] == 0).all()
    nothing = problem.analyse(scheme, space=space, observed=torch.zeros(*batch, 1, dtype=torch.bool))
    assert torch.equal(nothing.ensemble, problem.forecast)


@FIXED
@given(SEEDS, BATCHES, DIMS, DIMS, SCALES, SCALES, DTYPES)
def test_a_kalman_filter_in_other_units(seed, batch, states, readings, state_scale, scale, dtype):
    draw = Draw(seed)
    mean, cov = draw.normal(*batch, states), draw.covariance(*batch, states)
    F, Q = draw.normal(states, states), draw.covariance(states)
    H, R, reading = draw.normal(readings, states), draw.covariance(readings), draw.normal(*batch, readings)
    a, b = draw.units(state_scale, states), draw.units(scale, readings)

    def step(a, b, dtype):
        outer, other = a.unsqueeze(-1) * a, b.unsqueeze(-1) * b
        given = [mean * a, cov * outer, F * a.unsqueeze(-1) / a, Q * outer]
        forecast = kalman_predict(*(value.to(dtype) for value in given))
        given = [reading * b, H * b.unsqueeze(-1) / a, (R * other).expand(*batch, readings, readings)]
        return kalman_update(*forecast, *(value.to(dtype) for value in given))

    plain, scaled = step(torch.ones(states), torch.ones(readings), torch.float64), step(a, b, torch.float64)
    outer = a.unsqueeze(-1) * a
    close(scaled.mean / a, plain.mean, atol=1e-7)
    close(scaled.cov / outer, plain.cov, atol=1e-7)
    close(scaled.nis, plain.nis, rtol=1e-6, atol=1e-7)
    assert torch.equal(scaled.cov, scaled.cov.mT)
    assert (torch.linalg.eigvalsh(plain.cov) > -1e-9 * plain.cov.abs().max()).all()
    single = step(torch.ones(states), torch.ones(readings), dtype)
    assert {value.dtype for value in single} == {dtype}
    assert [value.shape for value in single] == [value.shape for value in plain]


@FIXED
@given(SEEDS, BATCHES, MEMBERS, DIMS, SCALES)
def test_moments_and_scores_scale_with_their_unit(seed, batch, members, states, scale):
    draw = Draw(seed)
    ensemble, truth, shift = draw.normal(*batch, members, states), draw.normal(*batch, states), draw.normal(states)
    order = draw.order(members)
    close(ensemble_cov(scale * ensemble), scale**2 * ensemble_cov(ensemble))
    close(ensemble_cov(ensemble).diagonal(dim1=-2, dim2=-1), ensemble_var(ensemble))
    for score in (crps_ensemble, energy_score):
        plain = score(ensemble, truth)
        close(score(scale * ensemble, scale * truth), scale * plain)
        close(score(ensemble + shift, truth + shift), plain)
        close(score(ensemble[..., order, :], truth), plain)
        assert (score(ensemble, truth, fair=False) >= -1e-12).all()
    mean, variance = ensemble_mean(ensemble), ensemble_var(ensemble)
    close(crps_gaussian(scale * mean, scale**2 * variance, scale * truth), scale * crps_gaussian(mean, variance, truth))
    cov = draw.covariance(*batch, states)
    wider = gaussian_log_prob(scale * truth, scale * mean, scale**2 * cov) + states * math.log(scale)
    close(wider, gaussian_log_prob(truth, mean, cov), atol=1e-7)


@FIXED
@given(SEEDS, BATCHES, MEMBERS, DIMS, SCALES, st.floats(1.0, 3.0), st.floats(0.0, 1.0))
def test_inflation_keeps_the_mean(seed, batch, members, states, scale, factor, relaxation):
    draw = Draw(seed)
    ensemble, forecast = scale * draw.normal(*batch, members, states), scale * draw.normal(*batch, members, states)
    for by in (factor, draw.units(factor, states)):
        inflated = inflate(ensemble, by)
        close(ensemble_mean(inflated), ensemble_mean(ensemble), atol=1e-7)
        close(ensemble_var(inflated), by**2 * ensemble_var(ensemble))
    relaxed = relax_to_prior_spread(ensemble, forecast, relaxation)
    wanted = (1 - relaxation) * ensemble_var(ensemble).sqrt() + relaxation * ensemble_var(forecast).sqrt()
    close(ensemble_mean(relaxed), ensemble_mean(ensemble), atol=1e-7)
    close(ensemble_var(relaxed).sqrt(), wanted)


@FIXED
@given(SEEDS, BATCHES, DIMS, SCALES, SCALES, DTYPES)
def test_sigma_points_have_the_moments(seed, batch, states, scale, spread, dtype):
    draw = Draw(seed)
    mean, units = scale * draw.normal(*batch, states), draw.units(spread, states)
    cov = draw.covariance(*batch, states) * units * units.unsqueeze(-1)
    weights = unscented_weights(states, dtype=torch.float64)
    points = sigma_points(mean, cov)
    found, found_cov = unscented_moments(points, weights)
    near = max(scale, spread)
    torch.testing.assert_close(found / near, mean / near, rtol=1e-9, atol=1e-9)
    limit = 1e-7 + 1e-13 * (scale / spread) ** 2  # what is left of a spread that is small compared with the mean
    outer = units * units.unsqueeze(-1)
    torch.testing.assert_close(found_cov / outer, cov / outer, rtol=limit, atol=limit)
    assert sigma_points(mean.to(dtype), cov.to(dtype)).dtype == dtype


@FIXED
@given(SEEDS, BATCHES, st.integers(2, 20), DIMS, SCALES, st.floats(0.0, 30.0), st.sampled_from([1, 20]))
def test_transported_particles_keep_the_mean(seed, batch, size, states, scale, sharpness, iterations):
    draw = Draw(seed)
    particles, units, order = draw.normal(*batch, size, states), draw.units(scale, states), draw.order(size)
    log_weights = torch.log_softmax(sharpness * draw.normal(*batch, size), -1)
    moved, weights = transport_resample(particles, log_weights, iterations=iterations)
    far, _ = transport_resample(particles + 100, log_weights, iterations=iterations)
    close(far.mean(-2), 100 + weighted_mean(particles, log_weights))
    close(moved.mean(-2), weighted_mean(particles, log_weights))
    assert (weights == -math.log(size)).all()
    options = {"iterations": iterations}
    close(transport_resample(particles * units, log_weights, **options)[0] / units, moved, atol=1e-6)
    shuffled, _ = transport_resample(particles[..., order, :], log_weights[..., order], **options)
    close(shuffled, moved[..., order, :], atol=1e-6)
