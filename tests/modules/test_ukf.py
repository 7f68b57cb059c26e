"""Oracles: the unscented filter written out in loops, a mean in closed form, a vehicle whose pose is known exactly.

What both Gaussian filters share (masks, noise, inflation, errors) is in ``test_ekf``.
"""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.gaussian_for_tests import directional_check
from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.functional.manifolds import Circle, Euclidean
from torch_denkf.modules import (
    ConstantNoise,
    LearnedObservation,
    LearnedTransition,
    Select,
    StochasticMLP,
    UKFAnalysis,
    UKFTransition,
)


def constant_noise(size, r=0.3):
    return ConstantNoise([r] * size, in_key=("belief", "mean"), out_key=("forecast", "noise"))


def bend(x):
    """Returns a nonlinear map of three dimensions."""
    return torch.stack([x[..., 0] + x[..., 1].sin(), x[..., 1] * x[..., 2], x[..., 2].exp()], -1)


def range_bearing(x):
    """Returns the distance and direction of the origin."""
    return torch.stack([x[..., :2].norm(dim=-1), torch.atan2(x[..., 1], x[..., 0])], -1)


def loops(mean, cov, function, alpha, beta, kappa):
    """Returns points, their images and both weights, one point at a time."""
    dim = len(mean)
    lam = alpha**2 * (dim + kappa) - dim
    root = np.linalg.cholesky((dim + lam) * cov)
    points = [mean] + [mean + root[:, i] for i in range(dim)] + [mean - root[:, i] for i in range(dim)]
    w_mean = [lam / (dim + lam)] + [0.5 / (dim + lam)] * (2 * dim)
    w_cov = [w_mean[0] + 1 - alpha**2 + beta, *w_mean[1:]]
    return points, [function(torch.from_numpy(p)).numpy() for p in points], w_mean, w_cov


@pytest.mark.parametrize("parameters", [(1.0, 0.0, 0.5), (0.5, 2.0, 0.0)])
def test_a_step_equals_the_textbook(float64, parameters):
    keys = dict(zip(("alpha", "beta", "kappa"), parameters, strict=True))
    mean = torch.tensor([[1.0, 0.5, 0.1], [2.0, 1.0, -0.3]])
    root = 0.3 * torch.randn(2, 3, 3)
    cov = root @ root.mT
    td = TensorDict({"belief": {"mean": mean, "cov": cov}, "reading": torch.randn(2, 2), "R": torch.rand(2, 2)}, [2])
    out = UKFTransition(LearnedTransition(bend, residual=False), constant_noise(3), **keys)(td)
    analysis = UKFAnalysis(
        LearnedObservation(range_bearing),
        **keys,
        observation_key="reading",
        noise_variance_key="R",
        reading_space=Euclidean(1) * Circle(),
    )
    out = analysis(out)
    for row in range(2):
        _, images, w_mean, w_cov = loops(mean[row].numpy(), cov[row].numpy(), bend, *parameters)
        m = sum(w * y for w, y in zip(w_mean, images, strict=True))
        P = sum(w * np.outer(y - m, y - m) for w, y in zip(w_cov, images, strict=True)) + 0.09 * np.eye(3)
        np.testing.assert_allclose(out["forecast", "mean"][row], m, rtol=0, atol=1e-11)
        np.testing.assert_allclose(out["forecast", "cov"][row], P, rtol=0, atol=1e-11)
        points, seen, w_mean, w_cov = loops(m, P, range_bearing, *parameters)
        assert max(abs(y[1] - seen[0][1]) for y in seen) < np.pi, "no point is across the cut"
        z = sum(w * y for w, y in zip(w_mean, seen, strict=True))
        S = sum(w * np.outer(y - z, y - z) for w, y in zip(w_cov, seen, strict=True)) + np.diag(td["R"][row])
        C = sum(w * np.outer(x - m, y - z) for w, x, y in zip(w_cov, points, seen, strict=True))
        innovation = td["reading"][row].numpy() - z
        innovation[1] = (innovation[1] + np.pi) % (2 * np.pi) - np.pi
        K = C @ np.linalg.inv(S)
        np.testing.assert_allclose(out["belief", "mean"][row], m + K @ innovation, rtol=0, atol=1e-10)
        np.testing.assert_allclose(out["belief", "cov"][row], P - K @ S @ K.T, rtol=0, atol=1e-10)
        nis = innovation @ np.linalg.inv(S) @ innovation
        np.testing.assert_allclose(out["info", "nis"][row], nis, rtol=1e-10)
        log_density = -0.5 * (nis + np.log(np.linalg.det(2 * np.pi * S)))
        np.testing.assert_allclose(out["info", "log_likelihood"][row], log_density, rtol=1e-10)


def test_a_forecast_bends_where_a_linearisation_is_straight(float64):
    # A vehicle that does not know its heading well: the mean falls short of where the heading's mean points.
    std = torch.tensor([0.0, 0.0, 0.5, 0.1, 0.0])
    mean = torch.tensor([0.0, 0.0, 0.0, 10.0, 0.0])
    move = UnicycleTransition(torch.zeros_like, dt=1.0)
    td = TensorDict({"belief": {"mean": mean, "cov": std.square().diag()}})
    out = UKFTransition(move, constant_noise(5, 1e-6))(td)
    # E cos(theta) = exp(-0.125): 8.82 m, where a linearisation says 10 m. The points err in the fourth order of 0.5.
    torch.testing.assert_close(out["forecast", "mean"][0], torch.tensor(8.825), rtol=0, atol=0.1)
    assert (out["forecast", "mean"][[1, 2, 4]].abs() < 1e-12).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_pose_that_is_known_exactly(dtype):
    # Only the velocities are uncertain, and only they get noise: the covariance has rank 0 to 4 for some steps.
    velocity = StochasticMLP(2, 2, (8,), layer="none", activation=nn.Tanh, output_gain=0.1).to(dtype)
    r = torch.tensor([0.5, 0.02], dtype=dtype)

    class VelocityNoise(nn.Module):
        in_keys, out_keys = [("belief", "mean")], [("forecast", "noise")]

        def forward(self, td):
            mean = td["belief", "mean"]
            return td.set(("forecast", "noise"), torch.cat([torch.zeros_like(mean[..., :3]), r.expand(4, 2) ** 2], -1))

    transition = UKFTransition(UnicycleTransition(velocity, 0.1).to(dtype), VelocityNoise())
    analysis = UKFAnalysis(Select([3, 4]))
    mean, cov = torch.zeros(4, 5, dtype=dtype), torch.zeros(4, 5, 5, dtype=dtype)
    mean[:, 3], cov[1:, 3, 3] = torch.linspace(0, 30, 4), 0.25
    given = TensorDict({"belief": {"mean": mean, "cov": cov}}, [4])
    given["sensor"] = {"ensemble": torch.randn(4, 2, dtype=dtype), "noise": torch.full((4, 2), 0.01, dtype=dtype)}
    given["observed"] = torch.tensor([[True], [True], [False], [True]])

    def steps():
        td = given.clone()
        for _ in range(20):
            td = analysis(transition(td))
            yield td["belief"]

    def loss():
        *_, last = steps()
        return last["mean"].square().sum() + last["cov"].square().sum()

    for step, belief in enumerate(steps()):
        found = belief["cov"].detach()
        scale = found.diagonal(dim1=1, dim2=2).clamp(min=1e-30).sqrt()
        correlation = found / scale.unsqueeze(-1) / scale.unsqueeze(-2)
        assert torch.linalg.eigvalsh(correlation).min() > -50 * torch.finfo(dtype).eps, step
        assert found.equal(found.mT)
        assert (found.diagonal(dim1=1, dim2=2)[:, 3:] > 0).all()
    gradients = torch.autograd.grad(loss(), list(velocity.parameters()))
    assert all(g.isfinite().all() and (g != 0).any() for g in gradients)
    # Where the ridge's directions amplify round-off, the gradient would be noise: it is that of a difference.
    if dtype == torch.float64:
        directional_check(loss, [velocity.layers[0].weight], rtol=1e-4)


def test_sigma_points_are_redrawn_for_the_analysis(float64):
    # With the forecast's points, process noise would not reach the innovation's covariance: S would be R.
    td = TensorDict({"belief": {"mean": torch.zeros(1), "cov": torch.zeros(1, 1)}})
    td["sensor"] = {"ensemble": torch.ones(1), "noise": torch.ones(1)}
    out = UKFAnalysis(Select([0]))(UKFTransition(LearnedTransition(nn.Identity()), constant_noise(1, 1.0))(td))
    torch.testing.assert_close(out["belief", "mean"], torch.tensor([0.5]), rtol=0, atol=1e-12)
    torch.testing.assert_close(out["info", "nis"], torch.tensor([0.5]), rtol=0, atol=1e-12)
