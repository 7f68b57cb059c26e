"""The likelihood of two readings, one analysis after the other. Oracles: one of both, and the joint density."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_system
from tests.filters.test_kalman import joint_gaussian
from torch_denkf.filters import Filter, KalmanFilter
from torch_denkf.modules import KalmanAnalysis, LinearTransition, MomentPrior
from torch_denkf.objectives import GaussianLoss

T = 6
NLL = {"state": 0.0, "transition": 0.0, "sensor": 0.0, "nll": 1.0, "reduction": "none"}


def exact(key, rows=slice(None)):
    """Returns the Kalman filter of some rows of the linear system's readings."""
    F, Q, H, R = linear_system()
    prior = {"mean": torch.tensor([1.0, -1.0]), "cov": torch.diag(torch.tensor([1.0, 2.0]))}
    return KalmanFilter(F, H[rows], process_noise_cov=Q, noise=R[rows].sqrt(), observation_key=key, **prior)


@pytest.mark.parametrize("info", [("info", "info"), ("gps_info", "info"), ("gps_info", "odometer_info")])
def test_two_analyses(float64, info):
    F, Q, H, R = linear_system()
    one, first = exact("both"), {"observation_key": "gps", "belief_prefix": "between", "info_prefix": info[0]}
    second = {"observation_key": "odometer", "forecast_prefix": "between", "info_prefix": info[1]}
    modules = {"transition": LinearTransition(F, Q), "gps": KalmanAnalysis(H[:1], R[:1], **first)}
    modules["odometer"] = KalmanAnalysis(H[1:], R[1:], **second)
    filter = Filter(modules, initial=MomentPrior(one.initial.mean, one.initial.cov))
    frames = TensorDict({"both": torch.randn(3, T, 2), "observed": torch.rand(3, T, 1) < 0.7}, [3, T])
    frames["gps"], frames["odometer"] = frames["both"].split(1, -1)
    loss = GaussianLoss(filter, **NLL)
    value = loss(frames)["loss_nll"]
    torch.testing.assert_close(value, GaussianLoss(one, **NLL)(frames)["loss_nll"], rtol=1e-10, atol=1e-12)
    # All of them are seen: the joint density of all readings but the first, of which the belief knows nothing.
    joint = joint_gaussian(one, T)
    rest = torch.distributions.MultivariateNormal(joint.mean[2:], joint.covariance_matrix[2:, 2:])
    value = loss(frames.exclude("observed"))["loss_nll"].sum(-1)
    torch.testing.assert_close(value, -rest.log_prob(frames["both"][:, 1:].reshape(3, -1)), rtol=1e-10, atol=0)
    key = (info[0], "log_likelihood") if len(set(info)) > 1 else ("info", "gps", "log_likelihood")
    loss.set_keys(log_likelihood=key)  # one of the two, by name
    alone = GaussianLoss(exact("gps", slice(1)), **NLL)(frames)["loss_nll"][:, 1]
    torch.testing.assert_close(loss(frames)["loss_nll"][:, 1], alone, rtol=1e-9, atol=1e-11)
