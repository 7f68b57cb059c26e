"""Oracle: the textbook equations in numpy."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torch_denkf.modules import KalmanAnalysis, LinearTransition, MomentPrior


@pytest.fixture
def system(float64):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    return {
        "F": rng.normal(size=(3, 3)),
        "Q": np.diag([0.1, 0.2, 0.3]),
        "H": rng.normal(size=(2, 3)),
        "R": np.array([0.5, 0.7]),
        "m": rng.normal(size=3),
        "P": root @ root.T + np.eye(3),
        "y": rng.normal(size=2),
    }


def tensors(*arrays):
    return [torch.from_numpy(array) for array in arrays]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_prior(system, batch):
    m, P = tensors(system["m"], system["P"])
    td = MomentPrior(m, P)(TensorDict({}, batch))
    assert td["belief", "mean"].equal(m.expand(*batch, 3))
    assert td["belief", "cov"].equal(P.expand(*batch, 3, 3))
    assert td["belief", "var"].equal(P.diagonal().expand(*batch, 3))


def test_transition(system):
    F, Q, m, P = (system[name] for name in "FQmP")
    td = TensorDict({"belief": dict(zip(("mean", "cov"), tensors(m, P), strict=True))})
    out = LinearTransition(*tensors(F, Q))(td)
    np.testing.assert_allclose(out["forecast", "mean"], F @ m, rtol=1e-13)
    np.testing.assert_allclose(out["forecast", "cov"], F @ P @ F.T + Q, rtol=1e-13)


@pytest.mark.parametrize("mask", [None, [True, False], [False, True], [False], [True]])
@pytest.mark.parametrize("full", [True, False])
def test_analysis(system, mask, full):
    H, R, m, P, y = (system[name] for name in "HRmPy")
    cov = np.diag(R) + (0.3 if full else 0.0) * (1 - np.eye(2))
    td = TensorDict({"forecast": dict(zip(("mean", "cov"), tensors(m, P), strict=True)), "y": torch.from_numpy(y)})
    if mask is not None:
        td["observed"] = torch.tensor(mask)
    module = KalmanAnalysis(torch.from_numpy(H), torch.from_numpy(cov if full else R), observation_key="y")
    out = module(td)
    kept = np.broadcast_to([True] if mask is None else mask, 2)
    H, cov, d = H[kept], cov[np.ix_(kept, kept)], (y - H @ m)[kept]
    S = H @ P @ H.T + cov
    K = P @ H.T @ np.linalg.inv(S)
    posterior = (np.eye(3) - K @ H) @ P
    nis = d @ np.linalg.solve(S, d)
    log_likelihood = -0.5 * (nis + np.linalg.slogdet(2 * np.pi * S)[1])
    np.testing.assert_allclose(out["belief", "mean"], m + K @ d, rtol=1e-12)
    np.testing.assert_allclose(out["belief", "cov"], posterior, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(out["belief", "var"], np.diag(posterior), rtol=1e-12)
    np.testing.assert_allclose(out["info", "innovation"], np.where(kept, y - system["H"] @ m, 0), atol=1e-13)
    np.testing.assert_allclose(out["info", "nis"], [nis], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(out["info", "log_likelihood"], [log_likelihood], rtol=1e-12, atol=1e-14)
