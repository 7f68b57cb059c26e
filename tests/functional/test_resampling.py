"""Oracles: the definition of each scheme, Monte Carlo over uniforms, linear programming, closed forms, gradcheck."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from torch_denkf.functional import crps_ensemble, soft_resample, systematic_resample, transport_resample
from torch_denkf.functional.moments import ensemble_var
from torch_denkf.functional.resampling import effective_sample_size, jitter_copies
from torch_denkf.functional.weighted import weighted_mean, weighted_median, weighted_var

pytestmark = pytest.mark.usefixtures("float64")

E, S = 6, 2
BATCHES = [(), (3,), (2, 2)]
SCHEMES = {
    "systematic": lambda x, w, u: systematic_resample(x, w, u),
    "soft": lambda x, w, u: soft_resample(x, w, u, alpha=0.3),
    "transport": lambda x, w, u: transport_resample(x, w, epsilon=0.3),
}


def problem(batch=(), size=E, dim=S, spread=1.0):
    return torch.randn(*batch, size, dim), (spread * torch.randn(*batch, size)).log_softmax(-1)


# ------------------------------------------------------------------------------------------- weighted particles


def test_weighted_moments_and_sample_size_by_hand():
    particles, log_weights = problem((3,))
    weights = log_weights.exp()
    mean = sum(weights[:, i, None] * particles[:, i] for i in range(E))
    square = sum(weights[:, i, None] * (particles[:, i] - mean) ** 2 for i in range(E))
    torch.testing.assert_close(weighted_mean(particles, log_weights), mean)
    torch.testing.assert_close(weighted_var(particles, log_weights), square * E / (E - 1))
    torch.testing.assert_close(effective_sample_size(log_weights), 1 / weights.square().sum(-1))


@pytest.mark.parametrize("batch", BATCHES)
def test_median_of_rational_weights_is_that_of_repeated_particles(batch):
    particles = torch.randn(*batch, 4, S)
    particles[..., 2, :] = torch.inf  # without weight
    counts = torch.tensor([2, 3, 0, 4])
    repeated = particles.repeat_interleave(counts, -2)
    found = weighted_median(particles, (counts / 9).log().expand(*batch, 4))
    torch.testing.assert_close(found, repeated.median(-2).values, rtol=0, atol=0)


@pytest.mark.parametrize("batch", BATCHES)
def test_crps_of_rational_weights_is_that_of_repeated_particles(batch):
    particles, target = torch.randn(*batch, 4, S), torch.randn(*batch, S)
    counts = torch.tensor([1, 3, 0, 4])
    repeated = particles.repeat_interleave(counts, -2)
    log_weights = (counts / 8).log().expand(*batch, 4)
    expected = crps_ensemble(repeated, target, fair=False)
    torch.testing.assert_close(crps_ensemble(particles, target, log_weights), expected)
    one = crps_ensemble(particles[..., :1, :], target, torch.zeros(*batch, 1))
    torch.testing.assert_close(one, (particles[..., 0, :] - target).abs())


# ------------------------------------------------------------------------------------------------ each scheme


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("batch", BATCHES)
def test_rows_are_resampled_by_themselves(scheme, batch):
    particles, log_weights = problem(batch)
    uniform = torch.rand(*batch, 1)
    out, weights = SCHEMES[scheme](particles, log_weights, uniform)
    torch.testing.assert_close(weights.logsumexp(-1), torch.zeros(batch))
    flat = [part.reshape(-1, *part.shape[len(batch) :]) for part in (particles, log_weights, uniform, out, weights)]
    for x, w, u, expected, expected_weights in zip(*flat, strict=True):
        one, one_weights = SCHEMES[scheme](x, w, u)
        torch.testing.assert_close(one, expected)
        torch.testing.assert_close(one_weights, expected_weights)


def counts_of(picked, particles):
    """Counts how often each of the particles was picked, ``[N, E]``."""
    return (picked.unsqueeze(-2) == particles.unsqueeze(-3)).all(-1).sum(-2)


def test_systematic_counts_are_floor_or_ceil():
    particles, log_weights = problem((50,), size=40)
    out, weights = systematic_resample(particles, log_weights, torch.rand(50, 1))
    counts, expected = counts_of(out, particles), 40 * log_weights.exp()
    assert ((counts == expected.floor()) | (counts == expected.ceil())).all()
    assert (counts.sum(-1) == 40).all()
    assert (weights == -math.log(40)).all()


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_soft_weights_correct_for_the_proposal(alpha):
    particles, log_weights = problem((50,), size=40)
    out, weights = soft_resample(particles, log_weights, torch.rand(50, 1), alpha)
    proposal = (1 - alpha) * log_weights.exp() + alpha / 40
    counts = counts_of(out, particles)
    assert ((counts >= (40 * proposal - 1e-9).floor()) & (counts <= (40 * proposal + 1e-9).ceil())).all()
    # All copies of particle i have the same weight, and these weights are in the ratio of w / q.
    index = (out.unsqueeze(-2) == particles.unsqueeze(-3)).all(-1).int().argmax(-1)
    ratio = (log_weights.exp() / proposal).gather(-1, index)
    torch.testing.assert_close(weights.exp(), ratio / ratio.sum(-1, keepdim=True))


@pytest.mark.parametrize("width", [1, E])
@pytest.mark.parametrize("alpha", [None, 0.3])
def test_weighted_sums_are_kept_in_expectation(width, alpha):
    # Unbiased: the sum of the unnormalised weights w / (E q) times any function of the particles.
    draws = 20_000
    particles, log_weights = problem(size=E)
    x, w = particles.expand(draws, E, S), log_weights.expand(draws, E)
    uniform = torch.rand(draws, width)
    if alpha is None:
        out, weights = systematic_resample(x, w, uniform)
        weights = weights.exp()
    else:
        out, _ = soft_resample(x, w, uniform, alpha)
        index = (out.unsqueeze(-2) == x.unsqueeze(-3)).all(-1).int().argmax(-1)
        weights = (w.exp() / ((1 - alpha) * w.exp() + alpha / E)).gather(-1, index) / E
    values = torch.cat([out, out.square()], -1)
    sums = (weights.unsqueeze(-1) * values).sum(-2)
    expected = weighted_mean(torch.cat([particles, particles.square()], -1), log_weights)
    standard_error = sums.std(0) / draws**0.5
    assert (standard_error > 0).all()
    assert ((sums.mean(0) - expected).abs() < 4 * standard_error).all()


@pytest.mark.parametrize("resample", [systematic_resample, soft_resample])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_particles_without_weight_are_never_picked(resample, dtype):
    # Uniforms at both ends, where rounding decides: the largest below one over E may round up to one.
    largest = 1 - torch.finfo(dtype).eps / 2
    uniform = torch.tensor([[0.0], [largest]], dtype=dtype)
    weights = torch.zeros(2, 1000, dtype=dtype)
    weights[:, 300:600] = 1 / 300
    particles = torch.arange(1000.0, dtype=dtype).expand(2, 1000).unsqueeze(-1)
    args = (0.0,) if resample is soft_resample else ()
    out, log_weights = resample(particles, weights.log(), uniform, *args)
    assert (out >= 300).all()
    assert (out < 600).all()
    assert log_weights.isfinite().all()


def test_no_gradient_through_hard_resampling():
    particles, log_weights = (value.requires_grad_() for value in problem())
    assert not any(value.requires_grad for value in systematic_resample(particles, log_weights, torch.rand(1)))


NORMAL = torch.randn(2, 4, S, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
DERIVED = {
    "weighted CRPS": lambda x, w: crps_ensemble(x, NORMAL[:, 0], w),
    "transport": lambda x, w: transport_resample(x, w, epsilon=0.3, iterations=10)[0],
    "jitter": lambda x, w: jitter_copies(x[:, [0, 0, 1, 3]], x, w, NORMAL, factor=0.8),
}


@pytest.mark.parametrize("name", DERIVED)
def test_gradients_are_those_of_finite_differences(name):
    inputs = (value.requires_grad_() for value in problem((2,), size=4))
    assert torch.autograd.gradcheck(lambda x, w: DERIVED[name](x, w.log_softmax(-1)), tuple(inputs))


@pytest.mark.parametrize("width", [1, E])
def test_gradient_of_soft_resampling(width):
    particles, log_weights = (value.requires_grad_() for value in problem((2,)))
    # Half-way between jumps; if a difference of 1e-6 crossed one, gradcheck would fail by a mile.
    uniform = torch.rand(2, width)
    assert torch.autograd.gradcheck(
        lambda x, w: soft_resample(x, w.log_softmax(-1), uniform, 0.3), (particles, log_weights)
    )
    out = soft_resample(particles, log_weights, uniform, 0.3)
    (gradient,) = torch.autograd.grad(weighted_mean(*out).sum(), log_weights)
    assert gradient.abs().max() > 0.01


# -------------------------------------------------------------------------------------------------- transport


def test_transport_without_regularisation_is_the_linear_programme():
    particles, log_weights = problem(size=5)
    scale = ensemble_var(particles).sqrt()
    cost = ((particles.unsqueeze(1) - particles) / scale).square().sum(-1) / 2
    rows, columns = np.kron(np.eye(5), np.ones(5)), np.kron(np.ones(5), np.eye(5))
    marginals = np.concatenate([np.full(5, 0.2), log_weights.exp().numpy()])
    plan = linprog(cost.flatten().numpy(), A_eq=np.concatenate([rows, columns]), b_eq=marginals).x.reshape(5, 5)
    out, _ = transport_resample(particles, log_weights, epsilon=0.005, iterations=5000)
    expected = 5 * torch.from_numpy(plan) @ particles
    # The regularised plan is off by exp(-gap / epsilon), and the gaps of five random points exceed ten epsilon.
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize(("dim", "epsilon"), [(1, 0.1), (1, 0.5), (2, 0.5)])
def test_transport_shrinks_the_spread_as_stated(dim, epsilon):
    # Quantiles of N(0, I) as particles, weighted with N(1, I): their weighted distribution is N(1/2, I/2), k^2 = 2.
    size = 400 if dim == 1 else 24
    nodes = torch.distributions.Normal(0.0, 1.0).icdf((torch.arange(size) + 0.5) / size)
    particles = torch.cartesian_prod(*[nodes] * dim).reshape(-1, dim)
    log_weights = (-0.5 * (particles - 1).square().sum(-1)).log_softmax(-1)
    out, _ = transport_resample(particles, log_weights, epsilon=epsilon, iterations=100)
    c = epsilon / 2 * (ensemble_var(particles) / weighted_var(particles, log_weights)).sqrt()
    share = out.std(-2) / weighted_var(particles, log_weights).sqrt()
    # Quantiles cut the tails: a few per mille in 400 points, a percent in 24.
    torch.testing.assert_close(share, (1 + c.square()).sqrt() - c, rtol=0, atol=0.003 if dim == 1 else 0.015)


def test_transport_of_a_single_likely_particle():
    particles, log_weights = problem(size=8, spread=500.0)
    assert effective_sample_size(log_weights) < 1.001
    out, _ = transport_resample(particles.requires_grad_(), log_weights.requires_grad_())
    torch.testing.assert_close(out, weighted_mean(particles, log_weights).expand(8, S), rtol=0, atol=1e-3)
    out.sum().backward()
    assert particles.grad.isfinite().all()
    assert log_weights.grad.isfinite().all()


# ----------------------------------------------------------------------------------------------------- jitter


def test_jitter_moves_the_copies_and_has_the_kernels_covariance():
    generator = torch.Generator().manual_seed(0)
    size = 200_000
    root = torch.tensor([[2.0, 0.5], [0.0, 1.0]], dtype=torch.float64)
    particles = torch.randn(size, 2, generator=generator, dtype=torch.float64) @ root
    log_weights = torch.zeros(size, dtype=torch.float64).log_softmax(-1)
    picked = particles[:1].expand(size, 2)
    normal = torch.randn(size, 2, generator=generator, dtype=torch.float64)
    moved = jitter_copies(picked, particles, log_weights, normal, factor=0.7)
    assert moved[0].equal(particles[0]), "one of each particle stays"
    width = 0.7 * size ** (-1 / 6)
    expected = width**2 * torch.cov(particles.T)
    torch.testing.assert_close(torch.cov((moved[1:] - particles[0]).T), expected, rtol=0.02, atol=1e-5)


def test_transport_ignores_particles_without_weight():
    particles, log_weights = problem((20,), size=40)
    near, far = particles.clone(), particles.clone()
    log_weights[:, :3] = -torch.inf
    log_weights = log_weights.log_softmax(-1)
    near[:, :3], far[:, :3] = weighted_mean(particles, log_weights).unsqueeze(-2), 1e6
    expected, _ = transport_resample(near, log_weights)
    found, _ = transport_resample(far, log_weights)
    torch.testing.assert_close(found, expected)
    # Not all the spread is lost to the regularisation, as it is where one scale must do for 1 and 1e6.
    assert ensemble_var(found).mean() > 0.7 * weighted_var(far, log_weights).mean()
