"""Particle smoothers against the exact smoother, and against enumeration."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch.testing import assert_close

from tests.filters.factories import NoisyLinear, linear_system
from tests.filters.gaussian_for_tests import known_process_noise
from tests.smoothers.joint import COV, MEAN, drive, joint_beliefs
from torch_denkf.filters import ParticleFilter
from torch_denkf.functional.gaussian import gaussian_log_prob
from torch_denkf.functional.smoothing.particles import backward_smooth, backward_weights
from torch_denkf.modules import ConstantNoise, GaussianLikelihood, GaussianPrior, LinearObservation, NoisyTransition
from torch_denkf.smoothers import FixedLag, ParticleSmoother
from torch_denkf.smoothers.particles import log_density_of_pairs


def particles(size, *, control=None, **kwargs):
    """Returns the linear system; its noise is one that has a density."""
    F, _, H, R = linear_system()
    return ParticleFilter(
        NoisyTransition(NoisyLinear(F, control=control), known_process_noise()),
        None,
        LinearObservation(H),
        GaussianLikelihood(observation_key="observation"),
        noise=ConstantNoise(R.sqrt(), in_key="observation"),
        initial=GaussianPrior(MEAN, torch.tensor(COV).sqrt(), ensemble_size=size),
        **kwargs,
    )


@pytest.mark.parametrize("lag", [None, 2])
def test_many_particles_are_the_exact_smoother(float64, lag):
    """Within 3.5 standard errors of as many draws as the fewest particles that ever counted."""
    frames, size = drive(2, 7), 1000
    mean, cov = joint_beliefs(frames, lag)
    with torch.no_grad():
        out = ParticleSmoother(particles(size), lag)(frames.copy())
    std, count = cov.diagonal(dim1=-2, dim2=-1).sqrt(), fewest(out, size)
    assert ((out["smoothed", "mean"] - mean).abs() < 3.5 * std / count.sqrt()).all()
    assert ((out["smoothed", "var"] / std.square() - 1).abs() < 3.5 * (2 / count).sqrt()).all()
    far = [((out[kind, "mean"] - mean) / std).square().mean().sqrt() for kind in ("smoothed", "belief")]
    assert far[0] < 0.15 < 0.3 < far[1]
    assert_close(out["smoothed", "log_weight"].exp().sum(-1), torch.ones(2, 7))


def test_ancestors_of_many_particles_equal_the_exact_smoother(float64):
    frames, size = drive(2, 7), 2000
    mean, cov = joint_beliefs(frames, 2)
    with torch.no_grad():
        out = FixedLag(particles(size), 2).sequence(frames.copy())
    bound = 2 * 5 * cov.diagonal(dim1=-2, dim2=-1).sqrt() / fewest(out, size).sqrt()
    late = out["smoothed", "age"].squeeze(-1)[:, 2:] == 2
    assert late.any()
    assert ((out["smoothed", "mean"][:, 2:] - mean[:, :-2]).abs() < bound[:, :-2])[late].all()


def fewest(out, size):
    """Returns the least effective number of particles in each row."""
    ess = out["info", "ess"]
    return torch.where(ess > 0, ess, size).amin(1, keepdim=True)  # 0 at a start


def test_backward_weights_are_bayes_rule_on_a_chain(float64):
    """Three particles at three times are the states of a chain: all 27 paths, enumerated."""
    generator = torch.Generator().manual_seed(0)
    moves = torch.randn(2, 3, 3, generator=generator)  # log p(to | from), up to a factor for each destination's place
    first = torch.randn(3, generator=generator).log_softmax(-1)
    likelihood = torch.randn(2, 3, generator=generator)
    beliefs = [first]
    for move, reading in zip(moves, likelihood, strict=True):
        beliefs.append((torch.logsumexp(beliefs[-1].unsqueeze(-1) + move, 0) + reading).log_softmax(-1))
    log_weights, densities = torch.stack(beliefs), torch.cat([torch.zeros(1, 3, 3), moves])
    two = (first[:, None] + moves[0] + likelihood[0]).flatten().softmax(0).reshape(3, 3)
    paths = first[:, None, None] + (moves[0] + likelihood[0])[:, :, None] + (moves[1] + likelihood[1])[None]
    paths = paths.flatten().softmax(0).reshape(3, 3, 3)
    expected = torch.stack([paths.sum((1, 2)), paths.sum((0, 2)), paths.sum((0, 1))])
    assert_close(backward_smooth(log_weights, densities).exp(), expected, rtol=0, atol=1e-12)
    of_one = backward_smooth(log_weights, densities, lag=1).exp()
    assert_close(of_one, torch.stack([two.sum(1), expected[1], expected[2]]), rtol=0, atol=1e-12)
    cut = backward_smooth(log_weights, densities, follows=torch.tensor([False, True, False]))
    assert_close(cut[1:], log_weights[1:], rtol=0, atol=0)
    assert_close(cut[0].exp(), two.sum(1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("read", ["belief", "forecast"])
def test_noise_that_depends_on_the_mean_reads_that_of_the_weighted_particles(float64, read):
    """Q is the square of the mean; backward by hand, from weights that are far from even."""
    F, _, H, R = linear_system()
    square = TensorDictModule(torch.square, [(read, "mean")], [("forecast", "noise")])
    filter = ParticleFilter(
        NoisyTransition(NoisyLinear(F), square),
        None,
        LinearObservation(H),
        GaussianLikelihood(observation_key="observation"),
        noise=ConstantNoise(0.3 * R.sqrt(), in_key="observation"),
        initial=GaussianPrior(MEAN, torch.tensor(COV).sqrt(), ensemble_size=6),
        resampling=None,
    )
    torch.manual_seed(0)
    out = ParticleSmoother(filter, 1)(drive(1, 3, missing=0.0, resets=False)[0])
    particles, weights = out["belief", "ensemble"], out["belief", "log_weight"]
    mean = (weights[1].exp().unsqueeze(-1) * particles[1]).sum(0)
    assert ((mean - particles[1].mean(0)).abs() > 0.1).all()
    cov = torch.diag((mean if read == "belief" else F @ mean).square())
    moves = torch.stack(
        [gaussian_log_prob(particles[2], (x @ F.mT).expand(6, 2), cov.expand(6, 2, 2)) for x in particles[1]]
    )
    expected = backward_weights(weights[1], moves, weights[2])
    assert_close(out["smoothed", "log_weight"][1], expected)


def test_gradients_are_those_of_finite_differences(float64):
    inputs = [torch.randn(2, 4).log_softmax(-1), torch.randn(2, 4, 4), torch.randn(2, 4).log_softmax(-1)]
    assert torch.autograd.gradcheck(backward_weights, [value.requires_grad_() for value in inputs])


@pytest.mark.parametrize("previous", [False, True])
def test_each_step_uses_the_action_that_led_into_it(float64, previous):
    """The action stored at a time leads out of it; a policy's data store it one step later."""
    control = torch.tensor([[3.0], [-2.0]])
    filter = particles(5, control=control)
    frames = drive(2, 4, resets=False, missing=0.0).exclude("observed")
    action = torch.randn(2, 4, 1)
    frames["action"] = action
    out = filter.sequence(frames)
    if previous:
        out["previous", "action"] = torch.cat([torch.zeros(2, 1, 1), action[:, :-1]], 1)
        del out["action"]
    entries = {key: out[key] for key in out.keys(True, True)}
    density = ParticleSmoother(filter)._densities(entries, out["belief", "ensemble"], out["belief", "log_weight"])
    F, Q, _, _ = linear_system()
    moved = out["belief", "ensemble"] @ F.mT + (action @ control.mT).unsqueeze(-2)
    expected = log_density_of_pairs(out["belief", "ensemble"][:, 1:], moved[:, :-1], Q.expand(2, 3, 2, 2))
    assert_close(density[:, 1:], expected, rtol=0, atol=1e-9)
