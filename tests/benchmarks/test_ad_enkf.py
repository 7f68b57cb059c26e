"""Likelihood and gradient of AD-EnKF: a Kalman filter, torch's own density and finite differences are the oracles."""

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import MultivariateNormal

from benchmarks.lorenz96.learned import forcing_of, make_filter, observe, simulate, tapers
from tests.filters.factories import linear_denkf, linear_system
from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.functional.localisation import gaspari_cohn
from torch_denkf.modules import EnsembleAnalysis, GaussianPrior
from torch_denkf.objectives import DEnKFLoss


@pytest.mark.parametrize("scheme", ["etkf", "perturbed"])
def test_a_large_ensemble_has_the_likelihood_and_the_gradient_of_the_kalman_filter(float64, scheme):
    F, Q, H, R = linear_system()
    mean, std, size = [1.0, -1.0], [1.0, 2.0], 40_000
    readings = torch.randn(8, 2)

    exact = F.clone().requires_grad_()
    m, P, log_likelihood = torch.tensor(mean), torch.diag(torch.tensor(std) ** 2), 0.0
    for reading in readings[1:]:  # the first belief is the prior
        m, P = kalman_predict(m, P, exact, Q)
        update = kalman_update(m, P, reading, H, R)
        m, P, log_likelihood = update.mean, update.cov, log_likelihood + update.log_likelihood.squeeze()
    log_likelihood.backward()

    prior = GaussianPrior(mean, std, ensemble_size=size)
    filter = linear_denkf(scheme, ensemble_size=size, noisy=True, initial=prior)
    filter["transition"].matrix = estimate = F.clone().requires_grad_()
    loss = DEnKFLoss.ad_enkf(filter, reduction="sum")
    value = loss(TensorDict({"observation": readings}, [8]))["loss_nll"]
    value.backward()
    # Seven steps, to each of which sampling adds a relative error of sqrt(2 / 40,000) = 0.007 of S.
    torch.testing.assert_close(-value, log_likelihood, rtol=0, atol=0.1)
    assert (estimate.grad + exact.grad).norm() < 0.03 * exact.grad.norm()


# ------------------------------------------------------------------------------------------------------ tapering


def members(dims, variables=8, size=5):
    ensemble = torch.randn(3, size, variables)
    sensor = {"ensemble": torch.randn(3, len(dims)), "noise": torch.rand(3, len(dims)) + 0.5}
    forecast = {"ensemble": ensemble, "observation": ensemble[..., dims]}
    return TensorDict({"forecast": forecast, "sensor": sensor, "noise": {"self": torch.randn(3, size, len(dims))}}, [3])


def test_tapered_update_is_its_formula(float64):
    dims, td = [0, 2, 4, 6], members([0, 2, 4, 6])
    out = EnsembleAnalysis("perturbed", taper=tapers(dims, 8, 1.5))(td.copy())
    forecast, y, R = td["forecast", "ensemble"], td["sensor", "ensemble"], td["sensor", "noise"]
    gap = torch.arange(8.0).unsqueeze(-1) - torch.arange(8.0)
    C = torch.stack([row.mT.cov() for row in forecast]) * gaspari_cohn(torch.minimum(gap % 8, -gap % 8), 1.5 * 0.3**0.5)
    S = C[:, dims][..., dims] + R.diag_embed()
    density = MultivariateNormal(forecast.mean(1)[:, dims], S)
    torch.testing.assert_close(out["info", "log_likelihood"].squeeze(-1), density.log_prob(y), rtol=0, atol=1e-11)
    gain = C[..., dims] @ S.inverse()
    mean = forecast.mean(1) + (gain @ (y - forecast.mean(1)[:, dims]).unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(out["belief", "mean"], mean, rtol=0, atol=1e-11)  # the perturbations have none


# ------------------------------------------------------------------------------------------------------ Lorenz-96


@pytest.mark.parametrize(("every", "radius"), [(1, None), (2, 3.0)])
def test_gradient_is_that_of_finite_differences(float64, every, radius):
    rng = torch.Generator().manual_seed(0)
    record = observe(simulate(8, 6, 2, rng), every, rng)
    filter = make_filter(8, every, 10, climate=(2.3, 3.6), radius=radius, learn_noise=True)
    filter.draw_noise(record)  # the same noise in every evaluation
    assert set(record["noise"].keys()) == {"initial", "transition", "analysis"}
    loss = DEnKFLoss.ad_enkf(filter)
    loss(record)["loss_nll"].backward()
    forcing, log_variance, step = forcing_of(filter), filter["transition"].module["noise"].log_variance, 1e-6
    for parameter, index in ((forcing, ()), (log_variance, (3,))):
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter[index] += sign * step
                values.append(loss(record)["loss_nll"])
                parameter[index] -= sign * step
        # Rounding of values of size 1e2 divided by the step, 1e-8, and the third derivative times its square.
        expected = (values[0] - values[1]) / (2 * step)
        torch.testing.assert_close(parameter.grad[index], expected, rtol=1e-6, atol=1e-6)
        assert abs(expected) > 1e-3
