"""Oracles: the Kalman filter, to which many particles come near, and importance sampling in closed form."""

import math

import pytest
import torch

from tests.filters.factories import linear_kalman, linear_system, random_draws
from tests.filters.particle_for_tests import E, bootstrap, readings
from torch_denkf.modules import GaussianPrior


def errors_by_size(sizes, rows_of, **kwargs):
    """Root-mean-square difference of the means, in standard deviations, for each number of particles."""
    td = readings(6)
    exact = linear_kalman().sequence(td.copy())["belief"][1:]
    errors = []
    for size in sizes:
        with torch.no_grad():
            out = bootstrap(size, **kwargs).sequence(td.expand(rows_of(size), 6).clone())
        # The rows are replications: all have the same readings.
        errors.append((out["belief", "mean"][:, 1:] - exact["mean"]) / exact["var"].sqrt())
    return [error.square().mean().sqrt() for error in errors], errors


def test_transport_comes_near_and_is_biased_by_its_regularisation(float64):
    rms, bias = {}, {}
    for epsilon in (0.05, 1.0):
        torch.manual_seed(0)  # the same readings
        options = {"resampling": "transport", "epsilon": epsilon}
        rms[epsilon], errors = errors_by_size([16, 128], lambda size: 4096 // size, **options)
        bias[epsilon] = errors[-1].mean(0).square().mean().sqrt()
    # Eight times the particles: 0.35 of the error, where it is not bias.
    assert rms[0.05][1] < 0.45 * rms[0.05][0]
    assert rms[0.05][1] < 0.3
    # The mean of 32 rows scatters by a sixth of one row's error: what exceeds it is bias, little of it and much.
    # It depends on the readings: ten sets of them gave 0.32 to 0.67 at an epsilon of 0.05, and 0.85 to 0.95 at 1.
    assert bias[0.05] < 0.5 * rms[0.05][1]
    assert bias[1.0] > 0.7 * rms[1.0][1]
    assert bias[1.0] > 3 * bias[0.05]


SCHEMES = {"systematic": {}, "soft": {"resampling": "soft", "alpha": 0.3}, "ess": {"ess_threshold": 0.5}}


@pytest.mark.parametrize("scheme", SCHEMES)
def test_many_particles_are_the_kalman_filter(float64, scheme):
    td = readings(20)
    td["observed"][7] = False
    exact = linear_kalman().sequence(td.copy())
    rows, size = 8, 5000
    with torch.no_grad():
        out = bootstrap(size, **SCHEMES[scheme]).sequence(td.expand(rows, 20).clone())
    unseen = ~td["observed"].any(-1)
    info = [("info", name) for name in ("innovation", "nis", "log_likelihood")]
    for key in (("belief", "mean"), ("belief", "var"), *info):
        error = out[key] - exact[key]
        if key[0] == "info":  # zero, exactly, where nothing is observed
            assert (out[key][:, unseen] == 0).all()
            error = error[:, ~unseen]
        error, hidden = error[:, 1:], ~td["observed"][~unseen][1:]
        if key[1] == "innovation":
            assert (error[:, hidden] == 0).all()
            error = error[:, ~hidden]
        # N(0, 1) over steps and dimensions if there is no bias, with a standard error from 8 rows; 3 would be a bias.
        z = error.mean(0) / (error.std(0) / rows**0.5)
        assert z.square().mean().sqrt() < 2, key
    away = (out["belief", "mean"] - exact["belief", "mean"]) / exact["belief", "var"].sqrt()
    assert away[:, 1:].square().mean().sqrt() < 0.05  # 5,000 particles, of which a third or so are left: 0.025
    assert (out["belief", "var"] / exact["belief", "var"] - 1)[:, 1:].abs().max() < 0.3
    assert (out["info", "log_likelihood"] - exact["info", "log_likelihood"])[:, 1:].abs().max() < 0.4
    # Standard errors of mean and variance of so many particles: about 2 %.
    seen = td["observed"].expand(rows, 20, 2)
    innovation, nis = (out["info", name] - exact["info", name] for name in ("innovation", "nis"))
    assert innovation[seen].abs().max() < 0.12
    assert (nis[:, 1:].abs() <= 0.04 + 0.12 * exact["info", "nis"][1:]).all()


def test_the_estimate_of_the_likelihood_is_unbiased(float64):
    # With few particles its logarithm is biased, and its value is not (Del Moral 2004, section 7.4).
    td = readings(5, masked=False)
    exact = linear_kalman().sequence(td.copy())["info", "log_likelihood"][1:].sum()
    with torch.no_grad():
        out = bootstrap(25).sequence(td.expand(8000, 5).clone())
    ratio = (out["info", "log_likelihood"][:, 1:].sum((1, 2)) - exact).exp()
    assert (ratio.mean() - 1).abs() < 4 * ratio.std() / 8000**0.5
    assert ratio.log().mean() < -0.05


def test_without_resampling_equals_importance_sampling(float64):
    # Deterministic motion: the weights are the products of the readings' densities along each particle's path.
    F, _, H, R = linear_system()
    start = GaussianPrior(torch.zeros(2), torch.ones(2), ensemble_size=E)
    filter = random_draws(bootstrap(E, noisy=False, initial=start, resampling=None))
    td = filter.draw_noise(readings(6, masked=False).expand(3, 6).clone())
    out = filter.sequence(td.copy())
    paths = [td["noise", "initial.initial"][:, 0]]
    log_weights = torch.zeros(3, E)
    for t in range(1, 6):
        paths.append(paths[-1] @ F.mT)
        normal = torch.distributions.Normal(paths[-1] @ H.mT, R.sqrt())
        log_weights = log_weights + normal.log_prob(td["observation"][:, t].unsqueeze(1)).sum(-1)
    torch.testing.assert_close(out["belief", "ensemble"][:, -1], paths[-1])
    torch.testing.assert_close(out["belief", "log_weight"][:, -1], log_weights.log_softmax(-1))
    evidence = torch.logsumexp(log_weights, -1) - math.log(E)
    torch.testing.assert_close(out["info", "log_likelihood"][:, 1:].sum((1, 2)), evidence)
