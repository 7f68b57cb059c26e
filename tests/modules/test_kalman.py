"""Oracle: the textbook equations in numpy."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torch_denkf.modules import CholeskyNoise, GaussianAround, KalmanAnalysis, LinearTransition


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


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_prior_around_a_state(float64, batch):
    state = torch.randn(*batch, 2)
    td = GaussianAround([0.0, 3.0], state_key="start")(TensorDict({"start": state.float()}, batch))
    torch.testing.assert_close(td["belief", "mean"], state, rtol=1e-6, atol=1e-6)
    assert td["belief", "mean"].dtype == torch.float64
    assert td["belief", "cov"].equal(torch.tensor([[0.0, 0.0], [0.0, 9.0]]).expand(*batch, 2, 2))
    assert td["belief", "var"].equal(torch.tensor([0.0, 9.0]).expand(*batch, 2))
    with pytest.raises(ValueError, match=r"std, .* must be finite and at least 0; got -1.0 at \[0\]"):
        GaussianAround([-1.0])


def test_control_and_learned_noise(system):
    F, m, P = tensors(*(system[name] for name in "FmP"))
    B, noise = torch.randn(3, 2), CholeskyNoise(3, r=[0.1, 0.2, 0.3])
    with torch.no_grad():
        noise.raw.normal_()
    td = TensorDict({"belief": {"mean": m.expand(4, 3), "cov": P.expand(4, 3, 3)}, "push": torch.randn(4, 2)}, [4])
    module = LinearTransition(F, noise, control=B, trainable=True, action_key="push")
    assert module.in_keys == [("belief", "mean"), ("belief", "cov"), "push"]
    out = module(td.copy())
    Q = noise(td.copy())["forecast", "noise"]
    torch.testing.assert_close(out["forecast", "mean"], m @ F.mT + td["push"] @ B.mT, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(out["forecast", "cov"], F @ P @ F.mT + Q, rtol=1e-12, atol=1e-12)
    assert {name for name, _ in module.named_parameters()} == {"matrix", "control", "noise.raw"}


def test_noise_and_samples_from_the_tensordict(system):
    H, R, m, P = tensors(*(system[name] for name in "HRmP"))
    samples = torch.randn(5, 2)
    td = TensorDict(
        {"forecast": {"mean": m, "cov": P}, "sensor": {"ensemble": samples, "noise": R}, "y": samples.mean(0)}
    )
    known = KalmanAnalysis(H, R, observation_key="y")(td.copy())
    read = KalmanAnalysis(H, None, observation_key=("sensor", "ensemble"))(td.copy())
    for name in ("mean", "cov", "var"):
        assert read["belief", name].equal(known["belief", name])
    inflated = KalmanAnalysis(H, R, observation_key="y", inflation=2.0)(td.copy())
    torch.testing.assert_close(inflated["belief", "cov"], 4 * known["belief", "cov"])
    td["observed"] = torch.tensor([False])
    unseen = KalmanAnalysis(H, R, observation_key="y", inflation=2.0)(td)
    torch.testing.assert_close(unseen["belief", "cov"], P, rtol=1e-13, atol=1e-13)
