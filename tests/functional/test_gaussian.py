"""Oracles: conditioning the joint Gaussian by its block formula, in information form, and torch's density."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.functional.gaussian import gaussian_log_prob

BATCHES = [(), (3,), (2, 3)]
# Condition numbers below 1e4 in double precision leave about 1e-12.
EXACT = {"rtol": 1e-9, "atol": 1e-9}


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def spd(*shape, seed=0):
    root = randn(*shape, shape[-1], seed=seed)
    return root @ root.mT + torch.eye(shape[-1])


def problem(batch=()):
    return randn(*batch, 4), spd(*batch, 4, seed=1), randn(*batch, 3, seed=2), randn(*batch, 3, 4, seed=3)


@pytest.mark.parametrize("diagonal", [True, False])
@pytest.mark.parametrize("batch", BATCHES)
def test_update_is_the_information_form(batch, diagonal):
    mean, cov, observation, matrix = problem(batch)
    noise = 0.1 + randn(*batch, 3).square() if diagonal else spd(*batch, 3)
    result = kalman_update(mean, cov, observation, matrix, noise)
    full = noise.diag_embed() if diagonal else noise
    information = torch.linalg.inv(cov) + matrix.mT @ torch.linalg.inv(full) @ matrix
    vector = torch.linalg.inv(cov) @ mean.unsqueeze(-1)
    vector = vector + matrix.mT @ torch.linalg.inv(full) @ observation.unsqueeze(-1)
    torch.testing.assert_close(result.cov, torch.linalg.inv(information), **EXACT)
    torch.testing.assert_close(result.mean, (torch.linalg.inv(information) @ vector).squeeze(-1), **EXACT)
    predicted = (matrix @ mean.unsqueeze(-1)).squeeze(-1)
    likelihood = MultivariateNormal(predicted, matrix @ cov @ matrix.mT + full).log_prob(observation)
    torch.testing.assert_close(result.log_likelihood.squeeze(-1), likelihood, **EXACT)
    torch.testing.assert_close(result.innovation, observation - predicted, **EXACT)
    assert torch.equal(result.cov, result.cov.mT)


@pytest.mark.parametrize("diagonal", [True, False])
def test_masked_components_are_as_if_absent(diagonal):
    mean, cov, observation, matrix = problem()
    noise = 0.1 + randn(3).square() if diagonal else spd(3)
    keep = torch.tensor([True, False, True])
    noise_kept = noise[keep] if diagonal else noise[keep][:, keep]
    expected = kalman_update(mean, cov, observation[keep], matrix[keep], noise_kept)
    observation[1] = torch.nan
    noise[..., 1] = torch.nan
    inputs = [tensor.requires_grad_() for tensor in (mean, cov, observation, matrix, noise)]
    result = kalman_update(*inputs, observed=keep)
    assert result.innovation[1] == 0
    torch.testing.assert_close(result.innovation[keep], expected.innovation, **EXACT)
    for name in ("mean", "cov", "nis", "log_likelihood"):
        torch.testing.assert_close(getattr(result, name), getattr(expected, name), **EXACT)
    gradients = torch.autograd.grad(sum(value.square().sum() for value in result), inputs)
    assert all(gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize("batch", BATCHES)
def test_prediction_moves_the_moments_of_samples_exactly(batch):
    mean, cov, _, _ = problem(batch)
    transition, noise = randn(4, 4, seed=5), spd(4, seed=6)
    new_mean, new_cov = kalman_predict(mean, cov, transition, noise)
    torch.testing.assert_close(new_mean, torch.einsum("ij,...j->...i", transition, mean), **EXACT)
    expected = torch.einsum("ij,...jk,lk->...il", transition, cov, transition) + noise
    torch.testing.assert_close(new_cov, expected, **EXACT)
    batched = kalman_predict(mean, cov, transition.expand(*batch, 4, 4), noise.expand(*batch, 4, 4))
    torch.testing.assert_close(batched, (new_mean, new_cov), **EXACT)


@pytest.mark.parametrize("batch", BATCHES)
def test_log_density_is_torchs(batch):
    mean, cov, _, _ = problem(batch)
    value = randn(*batch, 4, seed=7)
    expected = MultivariateNormal(mean, cov).log_prob(value)
    torch.testing.assert_close(gaussian_log_prob(value, mean, cov), expected, **EXACT)


def test_joseph_form_stays_positive_in_single_precision():
    # 200 very precise observations of the same state; the short form (I - KH) P turns indefinite here.
    mean, cov = torch.zeros(4), torch.eye(4)
    for step in range(200):
        matrix = randn(2, 4, seed=step).float()
        mean, cov, *_ = kalman_update(mean, cov, torch.zeros(2), matrix, torch.full((2,), 1e-6))
        assert torch.linalg.eigvalsh(cov.double()).min() > 0


def test_gradients_equal_finite_differences():
    mean, cov, observation, matrix = problem()
    inputs = [tensor.requires_grad_() for tensor in (mean, cov, observation, matrix, torch.ones(3).double())]

    def call(mean, cov, *rest):
        return kalman_update(mean, (cov + cov.mT) / 2, *rest)

    assert torch.autograd.gradcheck(call, inputs)


def test_an_indefinite_covariance_is_nan():
    assert gaussian_log_prob(torch.zeros(2), torch.zeros(2), -torch.eye(2)).isnan()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": torch.zeros(())}, r"mean must be \[\*B, S\]"),
        ({"cov": torch.eye(3)}, r"cov must be \[\*B, S, S\]"),
        ({"observation": torch.zeros(3, 2)}, "observation must be"),
        ({"observation_matrix": torch.zeros(2, 3)}, "observation_matrix must be"),
        ({"noise": torch.ones(3)}, "noise must be variances"),
        ({"noise": torch.eye(3)}, r"covariances \[\*B, O, O\]"),
        ({"observed": torch.ones(3, dtype=torch.bool)}, "observed must be"),
    ],
)
def test_errors_name_the_argument(change, message):
    arguments = {
        "mean": torch.zeros(4),
        "cov": torch.eye(4),
        "observation": torch.zeros(2),
        "observation_matrix": torch.zeros(2, 4),
        "noise": torch.ones(2),
    }
    with pytest.raises(ValueError, match=message):
        kalman_update(**(arguments | change))
    with pytest.raises(ValueError, match="transition must be"):
        kalman_predict(torch.zeros(4), torch.eye(4), torch.eye(3), torch.eye(4))
