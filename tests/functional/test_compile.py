"""Everything but the analysis in one compiled graph, forward and backward (the analysis: test_analysis)."""

import torch

from tests.functional.checks import assert_compiled_is_eager
from torch_denkf.functional import (
    crps_ensemble,
    energy_score,
    ensemble_mean,
    ensemble_var,
    kalman_predict,
    kalman_update,
)
from torch_denkf.functional.gaussian import gaussian_log_prob
from torch_denkf.functional.inflation import inflate, relax_to_prior_spread
from torch_denkf.functional.moments import ensemble_anomalies, ensemble_cov


def everything(ensemble, target, observed):
    mean, cov = ensemble_mean(ensemble), ensemble_cov(ensemble)
    mean, cov = kalman_predict(mean, cov, torch.eye(3) * 0.9, torch.eye(3))
    update = kalman_update(mean, cov, target[..., :2], torch.eye(2, 3), torch.ones(2, 2), observed=observed)
    inflated = inflate(ensemble, 1.1)
    return [
        ensemble_anomalies(ensemble),
        ensemble_var(ensemble),
        *update,
        gaussian_log_prob(target, update.mean, update.cov),
        relax_to_prior_spread(ensemble, inflated**3, 0.3),
        crps_ensemble(inflated, target),
        energy_score(inflated, target),
    ]


def test_compiled_equals_eager_forward_and_backward():
    generator = torch.Generator().manual_seed(0)
    ensemble = torch.randn(2, 5, 3, generator=generator, requires_grad=True)
    target = torch.randn(2, 3, generator=generator, requires_grad=True)
    observed = torch.tensor([[True, False], [True, True]])
    # Single-precision round-off.
    assert_compiled_is_eager(everything, ensemble, target, observed, rtol=1e-5, atol=1e-5, gradients=1e-4)
