"""Oracle: the binomial distribution, five standard deviations."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv, check_env_specs

from tests.transforms.envs_for_tests import base_env
from torch_denkf.envs import MissingFrames


@pytest.mark.parametrize("p", [0.0, 0.3, 1.0])
def test_rate_mask_and_zeros(p):
    n = 20_000
    td = TensorDict({"pixels": torch.rand(n, 2, 3, 3) + 0.1, "gps": torch.rand(n, 2) + 0.1}, [n])
    out = MissingFrames(p, in_keys=["pixels", "gps"])(td.clone())
    observed = out["observed"].squeeze(-1)
    assert abs((~observed).sum() - n * p) <= 5 * (n * p * (1 - p)) ** 0.5
    for key in ("pixels", "gps"):
        assert (out[key][~observed] == 0).all()
        assert out[key][observed].equal(td[key][observed])


@pytest.mark.parametrize("width", [1, 2])
def test_missing_readings_stay_missing(width):
    before = torch.rand(5000, width) < 0.5
    td = TensorDict({"gps": torch.ones(5000, 2), "observed": before}, [5000])
    out = MissingFrames(0.3, in_keys=["gps"])(td.clone())
    assert not (out["observed"] & ~before).any()
    kept = (out["gps"] != 0).any(-1, keepdim=True)
    assert out["observed"].equal(before & kept)
    assert abs((~kept).sum() - 1500) < 5 * (5000 * 0.3 * 0.7) ** 0.5


@pytest.mark.parametrize("batch", [(), (3,)])
def test_in_an_environment(batch):
    env = TransformedEnv(base_env(batch_size=batch, missing=0.3), MissingFrames(0.4, in_keys=["observation"]))
    check_env_specs(env)
    rollout = env.rollout(100)
    observed = rollout["observed"].squeeze(-1)
    n, p = observed.numel(), 1 - 0.7 * 0.6
    assert abs((~observed).sum() - n * p) < 5 * (n * p * (1 - p)) ** 0.5
    # Readings that the environment lost are NaN, those that the transform dropped are zero.
    missing = rollout["observation"][~observed]
    assert ((missing == 0) | missing.isnan()).all()
    assert rollout["observation"][observed].isfinite().all()
    assert (rollout["observation"][observed] != 0).all()
    # The frame of a reset counts like any other.
    resets = torch.stack([env.reset()["observed"] for _ in range(60)])
    assert resets.any()
    assert not resets.all()
