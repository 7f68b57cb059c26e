"""The likelihood of two readings, one analysis after the other. Oracles: one of both, and the joint density."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_system
from tests.filters.test_kalman import joint_gaussian
from torch_denkf.filters import Filter, KalmanFilter
from torch_denkf.functional.moments import ensemble_cov
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    KalmanAnalysis,
    LinearObservation,
    LinearTransition,
    MomentPrior,
)
from torch_denkf.objectives import DEnKFLoss, GaussianLoss

INFO = [("info", "info"), ("gps_info", "info"), ("gps_info", "odometer_info")]
T = 6


@pytest.fixture(autouse=True)
def _double(float64):
    return


def readings():
    frames = TensorDict({"both": torch.randn(3, T, 2), "observed": torch.rand(3, T, 1) < 0.7}, [3, T])
    frames["gps"], frames["odometer"] = frames["both"].split(1, -1)
    return frames


def start():
    return torch.tensor([1.0, -1.0]), torch.diag(torch.tensor([1.0, 2.0]))


def exact(key, rows=slice(None), *, process_noise_cov, mean, cov):
    """The Kalman filter of some rows of the linear system's readings."""
    F, _, H, R = linear_system()
    prior = {"mean": mean, "cov": cov, "observation_key": key}
    return KalmanFilter(F, H[rows], process_noise_cov=process_noise_cov, noise=R[rows].sqrt(), **prior)


@pytest.mark.parametrize("info", INFO)
def test_two_kalman_analyses(info):
    F, Q, H, R = linear_system()
    mean, cov = start()
    filter = Filter(
        {
            "transition": LinearTransition(F, Q),
            "gps": KalmanAnalysis(H[:1], R[:1], observation_key="gps", belief_prefix="between", info_prefix=info[0]),
            "odometer": KalmanAnalysis(
                H[1:], R[1:], observation_key="odometer", forecast_prefix="between", info_prefix=info[1]
            ),
        },
        initial=MomentPrior(mean, cov),
    )
    one = exact("both", process_noise_cov=Q, mean=mean, cov=cov)
    frames, off = readings(), {"state": 0.0, "transition": 0.0, "sensor": 0.0, "nll": 1.0, "reduction": "none"}
    value = GaussianLoss(filter, **off)(frames)["loss_nll"]
    torch.testing.assert_close(value, GaussianLoss(one, **off)(frames)["loss_nll"], rtol=1e-10, atol=1e-12)
    # All of them are seen: the joint density of all readings but the first, of which the belief knows nothing.
    joint = joint_gaussian(one, T)
    rest = torch.distributions.MultivariateNormal(joint.mean[2:], joint.covariance_matrix[2:, 2:])
    seen = frames.exclude("observed")
    value = GaussianLoss(filter, **off)(seen)["loss_nll"].sum(-1)
    torch.testing.assert_close(value, -rest.log_prob(frames["both"][:, 1:].reshape(3, -1)), rtol=1e-10, atol=0)


@pytest.mark.parametrize("info", INFO)
def test_two_ensemble_analyses(info):
    # Without process noise an ensemble is its own mean and covariance, and the square root filter is exact.
    F, Q, H, R = linear_system()
    members = torch.randn(5, 2)
    keys = {"forecast_key": ("between", "ensemble"), "predicted_key": ("between", "observation")}
    filter = Filter(
        {
            "gps_noise": ConstantNoise(R[:1].sqrt(), in_key="gps", out_key=("gps_noise", "R")),
            "odometer_noise": ConstantNoise(R[1:].sqrt(), in_key="odometer", out_key=("odometer_noise", "R")),
            "transition": NoisyLinear(F),
            "gps_observation": LinearObservation(H[:1]),
            "gps": EnsembleAnalysis(
                "etkf",
                observation_key="gps",
                noise_variance_key=("gps_noise", "R"),
                belief_prefix="between",
                info_prefix=info[0],
            ),
            "odometer_observation": LinearObservation(
                H[1:], in_key=("between", "ensemble"), out_key=("between", "observation")
            ),
            "odometer": EnsembleAnalysis(
                "etkf",
                observation_key="odometer",
                noise_variance_key=("odometer_noise", "R"),
                info_prefix=info[1],
                **keys,
            ),
        },
        initial=FixedEnsemble(members),
    )
    moments = {"process_noise_cov": 0 * Q, "mean": members.mean(0), "cov": ensemble_cov(members)}
    one = exact("both", **moments)
    frames, weights = readings(), {"state": 0.0, "transition": 0.0, "nll": 1.0, "reduction": "none"}
    value = DEnKFLoss(filter, **weights)(frames)["loss_nll"]
    expected = GaussianLoss(one, **weights)(frames)["loss_nll"]
    torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-11)
    loss = DEnKFLoss(filter, **weights)  # one of the two, by name
    loss.set_keys(
        log_likelihood=(info[0], "log_likelihood") if len(set(info)) > 1 else ("info", "gps", "log_likelihood")
    )
    first = loss(frames)["loss_nll"]
    alone = exact("gps", slice(1), **moments)
    only_first_step = GaussianLoss(alone, **weights)(frames)["loss_nll"][:, 1]
    torch.testing.assert_close(first[:, 1], only_first_step, rtol=1e-9, atol=1e-11)
