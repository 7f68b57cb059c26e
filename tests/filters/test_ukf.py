"""Tests what only the UKF has: parameters of its points, and covariances without full rank; see ``test_ekf``."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import assert_equal, linear_kalman
from tests.filters.gaussian_for_tests import BELIEF, INFO, linear_filter, linear_frames
from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.applications.car.modules.pairs import ClonedPrior, ClonedTransition, PairObservation
from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.filters import UKF
from torch_denkf.modules import CholeskyNoise, ConstantNoise, GaussianAround, Select, StochasticMLP


@pytest.mark.parametrize(("alpha", "beta", "kappa"), [(1.0, 0.0, 0.0), (1.0, 2.0, 1.0), (0.1, 2.0, 0.0)])
def test_any_points_are_exact_on_a_linear_system(float64, alpha, beta, kappa):
    filter = linear_filter("UKF", alpha=alpha, beta=beta, kappa=kappa)
    for part in ("transition", "analysis"):
        assert (filter[part].alpha, filter[part].beta, filter[part].kappa) == (alpha, beta, kappa)
    frames = linear_frames(3, 50)
    # With alpha = 0.1 the weights are of size 100, and so is the amplification of round-off.
    expected = linear_kalman().sequence(frames.copy())
    assert_equal(filter.sequence(frames.copy()), expected, [*BELIEF, *INFO], atol=1e-10)


def vehicle(lags):
    """Returns a vehicle whose pose is known at the start; with ``lags`` its state holds past velocities, too."""
    net = StochasticMLP(2, 2, (8,), activation=nn.Tanh, output_gain=0.1, layer="flipout")
    transition = UnicycleTransition(net, 0.1, scale=[5.0, 0.2])
    initial = GaussianAround([0.0, 0.0, 0.0, 0.5, 0.02])
    observation, keys = Select([3, 4]), {}
    if lags:
        transition, initial = ClonedTransition(transition), ClonedPrior(initial, lags)
        observation = PairObservation(history_key=None)
        keys = {"observed_key": ("forecast", "observed")}
    inner = CholeskyNoise(2, r=[0.5, 0.02], in_features=5 + 2 * lags)
    r = ConstantNoise([0.3, 0.01], trainable=True, in_key="reading")
    q = UnicycleNoise(inner, 0.1)
    return UKF(transition, None, observation, r, process_noise=q, initial=initial, observation_key="reading", **keys)


def drive(batch, steps, lags):
    state = torch.zeros(batch, steps, 5)
    state[..., 3] = torch.linspace(2, 20, batch).unsqueeze(-1)
    reading = state[..., 3:] + torch.randn(batch, steps, 2) * torch.tensor([0.3, 0.01])
    td = TensorDict({"state": state, "reading": reading, "observed": torch.rand(batch, steps, 1) < 0.8}, [batch, steps])
    if lags:
        td["steps"] = torch.randint(0, lags + 2, (batch, steps, 1))
        td["reading"] = td["reading"] * td["steps"]
    return td


@pytest.mark.parametrize("lags", [0, 2])
def test_a_known_pose_in_single_precision(lags):
    # float32, ranks 2 to 5 of 5 or 9 dimensions, 60 steps.
    filter = vehicle(lags)
    out = filter.sequence(drive(4, 60, lags))
    cov = out["belief", "cov"].detach()
    assert cov.isfinite().all()
    std = cov.diagonal(dim1=-2, dim2=-1).clamp(min=1e-30).sqrt()
    correlation = cov / std.unsqueeze(-1) / std.unsqueeze(-2)
    assert torch.linalg.eigvalsh(correlation).min() > -1e-5  # 90 eps: ten for each dimension
    assert (cov[:, 0, :3] == 0).all()
    assert (std[:, 1:] > 0).all()
    total = out["info", "log_likelihood"].sum() + out["belief", "mean"].square().sum()
    for name, parameter in filter.named_parameters():
        if "rho" in name:  # the spread of flipout's weights, which a deterministic network does not use
            continue
        (gradient,) = torch.autograd.grad(total, parameter, retain_graph=True)
        assert gradient.isfinite().all(), name
        assert (gradient != 0).any(), name
