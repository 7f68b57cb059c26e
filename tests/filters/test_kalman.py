"""Oracles: the Kalman filter in numpy, the joint Gaussian of all observations."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.distributions import MultivariateNormal

from tests.filters.factories import linear_denkf, linear_kalman, linear_system, random_draws
from torch_denkf.modules import GaussianPrior


def numpy_kalman(F, Q, H, R, m0, P0, readings, observed, starts, update_at_reset):
    """Runs one row and one step at a time, with plain inverses."""
    means, covs, squares, log_likelihoods = [], [], [], []
    m, P = m0, P0
    for y, seen, start in zip(readings, observed, starts, strict=True):
        m, P = (m0, P0) if start else (F @ m, F @ P @ F.T + Q)
        h, r, y = H[seen], np.diag(R[seen]), y[seen]
        S = h @ P @ h.T + r
        d = y - h @ m
        squares.append(0.0), log_likelihoods.append(0.0)  # of what is not read
        if update_at_reset or not start:
            squares[-1] = d @ np.linalg.inv(S) @ d
            log_likelihoods[-1] = -0.5 * (squares[-1] + np.log(np.linalg.det(2 * np.pi * S)))
            K = P @ h.T @ np.linalg.inv(S)
            m, P = m + K @ d, P - K @ S @ K.T
        means.append(m), covs.append(P)
    return np.stack(means), np.stack(covs), np.array(squares), np.array(log_likelihoods)


@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize("width", [1, 2])
def test_sequence_equals_numpy(float64, update_at_reset, width):
    B, T = 3, 40
    kf = linear_kalman(update_at_reset=update_at_reset)
    td = TensorDict({"observation": torch.randn(B, T, 2)}, [B, T])
    td["observed"] = torch.rand(B, T, width) < 0.7
    td["is_init"] = torch.rand(B, T, 1) < 0.1
    td["is_init"][:, 0] = True
    assert td["is_init"][:, 1:].any()
    out = kf.sequence(td)
    m0, P0 = kf.initial.mean.numpy(), kf.initial.cov.numpy()
    for row in range(B):
        means, covs, squares, log_likelihoods = numpy_kalman(
            *(matrix.numpy() for matrix in linear_system()),
            m0,
            P0,
            td["observation"][row].numpy(),
            np.broadcast_to(td["observed"][row].numpy(), (T, 2)),
            td["is_init"][row].flatten().numpy(),
            update_at_reset,
        )
        # Joseph form against P - K S K': 1e-16 a step on numbers of size 1, contracted by the filter.
        np.testing.assert_allclose(out["belief", "mean"][row], means, rtol=0, atol=1e-12)
        np.testing.assert_allclose(out["belief", "cov"][row], covs, rtol=0, atol=1e-12)
        np.testing.assert_allclose(out["belief", "var"][row], np.diagonal(covs, axis1=1, axis2=2), rtol=0, atol=1e-12)
        np.testing.assert_allclose(out["info", "nis"][row].flatten(), squares, rtol=0, atol=1e-11)
        np.testing.assert_allclose(out["info", "log_likelihood"][row].flatten(), log_likelihoods, rtol=0, atol=1e-11)


def joint_gaussian(kf, T, S=2):
    """Returns the mean and covariance of y_1 .. y_T, stacked, by the system's impulse responses."""
    F, Q, H, R = linear_system()
    F_to = [torch.linalg.matrix_power(F, k) for k in range(T)]
    mean = torch.cat([H @ power @ kf.initial.mean for power in F_to])
    state = torch.zeros(T, S, T, S)
    for s in range(T):
        for t in range(T):
            cov = F_to[s] @ kf.initial.cov @ F_to[t].mT
            for k in range(1, min(s, t) + 1):
                cov = cov + F_to[s - k] @ Q @ F_to[t - k].mT
            state[s, :, t] = cov
    big_H = torch.block_diag(*[H] * T)
    cov = big_H @ state.reshape(T * S, T * S) @ big_H.mT + torch.diag(R.repeat(T))
    return MultivariateNormal(mean, cov)


def test_log_likelihoods_add_up_to_the_joint_density(float64):
    kf, T = linear_kalman(update_at_reset=True), 12
    readings = torch.randn(3, T, 2)
    out = kf.sequence(TensorDict({"observation": readings}, [3, T]))
    expected = joint_gaussian(kf, T).log_prob(readings.reshape(3, -1))
    torch.testing.assert_close(out["info", "log_likelihood"].sum((1, 2)), expected, rtol=1e-11, atol=0)


@pytest.mark.parametrize("scheme", ["perturbed", "etkf"])
def test_large_ensemble_is_the_kalman_filter(float64, scheme):
    E, rows, T = 10_000, 8, 50
    kf = linear_kalman()
    prior = GaussianPrior(kf.initial.mean, kf.initial.cov.diagonal().sqrt(), ensemble_size=E)
    denkf = random_draws(linear_denkf(scheme, ensemble_size=E, noisy=True, initial=prior))
    # The same readings in all rows: the rows are replications, and tell the Monte-Carlo error of one run.
    td = TensorDict({"observation": torch.randn(T, 2), "observed": torch.rand(T, 2) < 0.8}, [T])
    exact = kf.sequence(td.copy())
    out = denkf.sequence(td.expand(rows, T).clone())
    for key in (("belief", "mean"), ("belief", "var"), ("info", "log_likelihood")):
        error = out[key] - exact[key]
        if key[-1] == "log_likelihood":  # zero, exactly, where nothing is observed, and of the prior
            unread = ~td["observed"].any(-1)
            unread[0] = True
            assert (out[key][:, unread] == 0).all()
            error = error[:, ~unread]
        standard_error = error.std(0)
        # Root mean square over steps and dimensions of what is N(0, 1) if the filter is right: near 1. In single
        # steps three standard errors are exceeded by chance; in the root mean square three would be a bias.
        assert (error / standard_error).square().mean().sqrt() < 3, key
        # All rows' mean has an eighth of the variance; a bias of 1 standard error of one run would show as 2.8.
        z = error.mean(0) / (standard_error / rows**0.5)
        assert z.square().mean().sqrt() < 3, key
        # And the errors are small: an iid sample of the belief has 1 / sqrt(E) = 1 % of its standard deviation.
        if key[-1] == "mean":
            assert (error / exact["belief", "var"].sqrt()).abs().max() < 0.1
        elif key[-1] == "var":
            assert (error / exact["belief", "var"]).abs().max() < 0.15
        else:
            assert error.abs().max() < 0.3
