"""Oracles: the moments of quadratics in closed form, the Kalman update on linear observations."""

import math

import pytest
import torch

from torch_denkf.functional import kalman_update, sigma_points, wrap_angles
from torch_denkf.functional.manifolds import Circle
from torch_denkf.functional.unscented import unscented_moments, unscented_update, unscented_weights

F64 = torch.float64
# Sums of a few dozen numbers of size 1 in double precision; the ridge of 10 S eps shrinks correlations by 1e-14.
EXACT = {"rtol": 1e-12, "atol": 1e-12}
PARAMETERS = [(1.0, 0.0, 0.5), (1.0, 2.0, 0.0), (0.3, 2.0, 1.0)]


def gaussian(*batch, dim=3, rank=None, seed=0):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(*batch, dim, rank or dim, generator=generator, dtype=F64)
    return torch.randn(*batch, dim, generator=generator, dtype=F64), root @ root.mT


def transform(mean, cov, function, alpha=1.0, beta=0.0, kappa=0.5, **kwargs):
    weights = unscented_weights(mean.shape[-1], alpha=alpha, beta=beta, kappa=kappa, dtype=mean.dtype)
    return unscented_moments(function(sigma_points(mean, cov, alpha=alpha, kappa=kappa)), weights, **kwargs)


@pytest.mark.parametrize(("alpha", "beta", "kappa"), PARAMETERS)
@pytest.mark.parametrize("rank", [1, 2, 3])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_the_points_have_the_moments_of_the_gaussian(alpha, beta, kappa, rank, batch):
    mean, cov = gaussian(*batch, rank=rank)
    points = sigma_points(mean, cov, alpha=alpha, kappa=kappa)
    assert points.shape == (*batch, 7, 3)
    assert points[..., 0, :].equal(mean)
    weights = unscented_weights(3, alpha=alpha, beta=beta, kappa=kappa, dtype=F64)
    torch.testing.assert_close(weights.mean.sum(), torch.ones((), dtype=F64), **EXACT)
    # With alpha = 0.3 the weights are of size 10.
    for value, expected in zip(unscented_moments(points, weights), (mean, cov), strict=True):
        torch.testing.assert_close(value, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("alpha", "beta", "kappa"), PARAMETERS)
def test_means_are_exact_up_to_third_order(alpha, beta, kappa):
    mean, cov = gaussian(5)
    quadratic = torch.randn(3, 3, dtype=F64)
    # E x' A x = m' A m + tr(A P), and E x_0^3 = m^3 + 3 m var.
    got, _ = transform(
        mean, cov, lambda x: torch.stack([((x @ quadratic) * x).sum(-1), x[..., 0] ** 3], -1), alpha, beta, kappa
    )
    expected = torch.einsum("bi,ij,bj->b", mean, quadratic, mean) + torch.einsum("ij,bji->b", quadratic, cov)
    torch.testing.assert_close(got[:, 0], expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(got[:, 1], mean[:, 0] ** 3 + 3 * mean[:, 0] * cov[:, 0, 0], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("dim", "alpha", "beta", "kappa"), [(1, 1.0, 2.0, 0.0), (1, 0.5, 2.0, 0.0), (2, 1.0, 1.0, 0.0), (3, 1.0, 1.0, -1.0)]
)
def test_variance_of_a_sum_of_squares_is_exact_where_it_should_be(dim, alpha, beta, kappa):
    mean, factor = torch.randn(dim, dtype=F64), torch.rand(dim, dtype=F64) + 0.5
    variance = torch.rand(dim, dtype=F64) + 0.5
    _, cov = transform(mean, variance.diag(), lambda x: (factor * x**2).sum(-1, keepdim=True), alpha, beta, kappa)
    expected = (factor**2 * (4 * mean**2 * variance + 2 * variance**2)).sum()
    torch.testing.assert_close(cov.squeeze(), expected, rtol=1e-11, atol=0)


def test_dimensions_without_variance_stay_and_gradients_are_finite():
    mean, cov = gaussian(4, dim=4, rank=2)
    cov[:, 1] = cov[:, :, 1] = 0
    cov[3] = 0
    cov.requires_grad_()
    points = sigma_points(mean, cov)
    assert (points[..., 1] == mean[:, None, 1]).all()
    assert points[3].equal(mean[3].expand(9, 4))
    matrix, weight = torch.randn(4, 4, dtype=F64), torch.randn(4, 4, dtype=F64)
    weight = weight + weight.mT
    _, moved = unscented_moments(points @ matrix.mT, unscented_weights(4, dtype=F64))
    (gradient,) = torch.autograd.grad((moved * weight).sum(), cov)
    assert gradient.isfinite().all()
    # d tr(G F P F') / dP = F' G F, for changes of P that keep it a covariance of the same dimensions.
    change = torch.zeros(4, 4, 4, dtype=F64)
    change[:3] = cov[:3].detach()  # the same correlations, larger
    got, expected = (gradient * change).sum((1, 2)), (matrix.mT @ weight @ matrix * change).sum((1, 2))
    # Two of the four directions have no variance but the ridge's: sqrt(4e-14) amplifies round-off to 1e-9.
    torch.testing.assert_close(got, expected, rtol=1e-7, atol=1e-7)


def test_gram_matrices_in_single_precision_have_points():
    # Rank 2 in 9 dimensions from 1e-4 to 1e3, as for metres and milliradians: no NaN, and variances to rounding.
    scale = torch.logspace(-4, 3, 9)
    root = scale.unsqueeze(-1) * torch.randn(2000, 9, 2)
    cov = root @ root.mT
    points = sigma_points(torch.zeros(2000, 9), cov)
    assert points.isfinite().all()
    _, back = unscented_moments(points, unscented_weights(9))
    variance = cov.diagonal(dim1=1, dim2=2)
    torch.testing.assert_close(back.diagonal(dim1=1, dim2=2), variance, rtol=1e-5, atol=0)
    assert ((back - cov).abs() / (variance.sqrt().unsqueeze(-1) * variance.sqrt().unsqueeze(-2)) < 1e-4).all()


@pytest.mark.parametrize("width", [None, 1, 2])
@pytest.mark.parametrize("full_noise", [False, True])
def test_update_equals_kalman_update_on_a_linear_observation(width, full_noise):
    mean, cov = gaussian(6, 2)
    matrix, observation = torch.randn(2, 3, dtype=F64), torch.randn(6, 2, 2, dtype=F64)
    noise = gaussian(6, 2, dim=2, seed=1)[1] + torch.eye(2, dtype=F64)
    noise = noise if full_noise else noise.diagonal(dim1=-2, dim2=-1)
    observed = None if width is None else torch.rand(6, 2, width) < 0.5
    if width is not None:
        observation = torch.where(observed, observation, torch.nan)
    points = sigma_points(mean, cov)
    got = unscented_update(
        points, points @ matrix.mT, observation, noise, unscented_weights(3, dtype=F64), observed=observed
    )
    expected = kalman_update(mean, cov, observation, matrix, noise, observed=observed)
    for name, value in got._asdict().items():
        torch.testing.assert_close(value, getattr(expected, name), rtol=1e-10, atol=1e-10, msg=name)


def test_gradients_through_points_moments_and_update():
    mean, cov = gaussian(2)
    observation = torch.randn(2, 1, dtype=F64)
    weights = unscented_weights(3, dtype=F64)

    def two_steps(mean, root, observation):
        mean, cov = unscented_moments(sigma_points(mean, root @ root.mT).sin(), weights)
        points = sigma_points(mean, cov + torch.eye(3, dtype=F64))
        norm = points.square().sum(-1, keepdim=True)
        update = unscented_update(points, norm, observation, torch.ones(2, 1, dtype=F64), weights)
        return update.mean, update.cov, update.log_likelihood

    inputs = [value.requires_grad_() for value in (mean, torch.linalg.cholesky(cov), observation)]
    assert torch.autograd.gradcheck(two_steps, inputs)


def test_angles_are_averaged_and_compared_across_pi():
    mean, cov = torch.tensor([math.pi - 0.1], dtype=F64), torch.tensor([[0.25]], dtype=F64)
    wrap = wrap_angles
    got_mean, got_cov = transform(mean, cov, wrap, space=Circle())
    torch.testing.assert_close(got_mean, mean, **EXACT)
    torch.testing.assert_close(got_cov, cov, **EXACT)
    points = sigma_points(mean, cov)
    one = torch.ones(1, dtype=F64)
    update = unscented_update(
        points, wrap(points), wrap(mean + 0.2), one, unscented_weights(1, dtype=F64), space=Circle()
    )
    torch.testing.assert_close(update.innovation, 0.2 * one, **EXACT)
    torch.testing.assert_close(update.mean, mean + 0.2 * 0.25 / 1.25, **EXACT)
