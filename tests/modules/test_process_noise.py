"""Oracles: matrix products written out, the Jacobian of the vehicle's motion by automatic differentiation."""

import math

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.modules import CholeskyNoise, ConstantNoise, MappedNoise

FORECAST = {"in_key": ("belief", "mean"), "out_key": ("forecast", "noise")}


def belief(*batch, dim=3):
    return TensorDict({("belief", "mean"): torch.randn(*batch, dim)}, batch)


@pytest.mark.parametrize("constant", [True, False])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_untrained_covariance_is_diagonal(float64, constant, batch):
    noise = CholeskyNoise(3, r=[0.1, 1.0, 2.0], constant=constant)
    cov = noise(belief(*batch))["forecast", "noise"]
    expected = torch.diag(torch.tensor([0.01, 1.0, 4.0])).expand(*batch, 3, 3)
    torch.testing.assert_close(cov, expected, rtol=1e-13, atol=1e-15)


def test_a_constant_one_is_its_factor(float64):
    noise = CholeskyNoise(2, r=2.0, floor=1.0)
    with torch.no_grad():
        noise.raw.copy_(torch.tensor([0.3, -0.7, 1.1]))
    diagonal = torch.nn.functional.softplus(noise.raw[[0, 2]] + math.log(math.e - 1))
    factor = 3**0.5 * torch.stack(
        [torch.stack([diagonal[0], 0 * diagonal[0]]), torch.stack([noise.raw[1], diagonal[1]])]
    )
    cov = noise(belief(5, dim=2))["forecast", "noise"]
    torch.testing.assert_close(cov, (factor @ factor.mT + torch.eye(2)).expand(5, 2, 2), rtol=1e-12, atol=0)


def test_covariances_stay_positive_and_depend_on_the_input(float64):
    noise = CholeskyNoise(3, r=0.5, constant=False)
    with torch.no_grad():
        for parameter in noise.parameters():
            parameter.copy_(torch.randn_like(parameter))
    cov = noise(belief(100))["forecast", "noise"]
    assert cov.equal(cov.mT)
    assert (torch.linalg.eigvalsh(cov) > 0.99 * 0.01 * 0.25).all(), "the floor is 1 % of r^2"
    assert (cov - cov[0]).abs().amax((1, 2))[1:].min() > 0
    cov.sum().backward()
    assert all((p.grad != 0).any() and p.grad.isfinite().all() for p in noise.parameters())


def test_infinite_scale_hides_a_feature(float64):
    noise = CholeskyNoise(1, constant=False, in_features=2, scale=[torch.inf, 1.0])
    torch.nn.init.normal_(noise.module.layers[-1].weight)
    td = TensorDict({("belief", "mean"): torch.tensor([[1.0, 2.0], [1e6, 2.0], [1.0, 3.0]])}, [3])
    first, far, other = noise(td)["forecast", "noise"].flatten()
    assert first == far
    assert first != other


@pytest.mark.parametrize(
    "inner", [CholeskyNoise(2, r=[0.5, 2.0], in_features=3), ConstantNoise([0.5, 2.0], **FORECAST)]
)
def test_mapped_noise_is_g_q_g(inner):
    matrix = torch.tensor([[1.0, 2.0], [0.0, 0.0], [0.0, 3.0]])
    cov = MappedNoise(inner, matrix)(belief(4))["forecast", "noise"]
    torch.testing.assert_close(cov, (matrix @ torch.diag(torch.tensor([0.25, 4.0])) @ matrix.mT).expand(4, 3, 3))


@pytest.mark.parametrize("clones", [0, 2])
def test_unicycle_noise_is_the_effect_of_the_new_velocities(float64, clones):
    dt, change = 0.3, (torch.randn(6, 2) * torch.tensor([5.0, 1.0])).requires_grad_()  # new velocities are not the old
    mean = torch.randn(6, 5) * torch.tensor([10.0, 10.0, 2.0, 10.0, 1.0])
    move = UnicycleTransition(lambda v: change.unsqueeze(-2), dt)
    forecast = lambda change: move(  # noqa: E731
        TensorDict({("belief", "ensemble"): mean.unsqueeze(-2)}, [6])
    )["forecast", "ensemble"].squeeze(-2)
    rows = [torch.autograd.grad(forecast(change)[:, i].sum(), change)[0] for i in range(5)]
    G = torch.stack(rows, 1)  # [6, 5, 2]
    Q = torch.tensor([[0.5, 0.1], [0.1, 0.2]])
    inner = CholeskyNoise(2, in_features=5)
    root = torch.linalg.cholesky(Q - inner.floor.diag()) / inner.std.unsqueeze(-1)
    with torch.no_grad():
        raw = root[torch.tril_indices(2, 2).unbind()]
        raw[[0, 2]] = raw[[0, 2]].expm1().log() - math.log(math.e - 1)
        inner.raw.copy_(raw)
    pad = torch.zeros(6, 2 * clones)
    td = TensorDict({("belief", "mean"): torch.cat([mean, pad], -1)}, [6])
    td["forecast", "mean"] = torch.cat([forecast(change).detach(), pad], -1)
    cov = UnicycleNoise(inner, dt)(td)["forecast", "noise"]
    torch.testing.assert_close(cov[:, :5, :5], G @ Q @ G.mT, rtol=1e-11, atol=1e-12)
    assert (cov[:, 5:] == 0).all()
    assert (cov[:, :, 5:] == 0).all()
