"""The belief of t - lag next to that of t, in environments: specs, workers, resets, and the smoother as the oracle."""

import pytest
import torch
from torchrl.envs import InitTracker, TransformedEnv, check_env_specs

from tests.filters.factories import assert_equal, linear_kalman, linear_system
from tests.transforms import envs_for_tests as envs
from torch_denkf.envs.linear import LinearGaussianEnv
from torch_denkf.smoothers import EnKS, FixedLag, RTSSmoother
from torch_denkf.transforms import DEnKFTransform

LAG = 2
CONTROL = torch.tensor([[1.0], [-0.5]])
KEYS = [("smoothed", name) for name in ("mean", "var", "age")]
FILTERS = {"ensemble": envs.fixed_filter, "Kalman": linear_kalman}


def lagged_env(name, **kwargs):
    env = TransformedEnv(envs.base_env(**kwargs), DEnKFTransform(FixedLag(FILTERS[name](), LAG)))
    return TransformedEnv(env, InitTracker())


@pytest.mark.parametrize("name", FILTERS)
def test_a_rollout_is_the_recording_smoothed(float64, name):
    """Rows reset at different times; what an environment says later is what the smoother says of the time before."""
    env = lagged_env(name, batch_size=[2], max_steps=[3, 7], seed=0)
    rollout = envs.random_rollout(env, 12)
    assert rollout["is_init"].sum() == 6, "both rows start again inside"
    online = FixedLag(FILTERS[name](), LAG)
    frames = rollout.select("observation", "observed", "is_init")
    assert_equal(rollout, online.sequence(frames.copy()), [*KEYS, ("belief", "mean")], atol=1e-9)
    smoother = EnKS if name == "ensemble" else RTSSmoother
    whole = smoother(FILTERS[name](), LAG)(frames.copy())
    age = rollout["smoothed", "age"].squeeze(-1)
    for row in range(2):
        for t in range(LAG, 12):
            if age[row, t] == LAG:
                for key in ("mean", "var"):
                    now, then = rollout["smoothed", key][row, t], whole["smoothed", key][row, t - LAG]
                    torch.testing.assert_close(now, then, rtol=0, atol=1e-9)
    assert (age == LAG).sum() > 5


def controlled_env(**kwargs):
    """Actions drive the system, and the Kalman filter knows how."""
    F, Q, H, R = linear_system()
    plain = LinearGaussianEnv(F, H, Q.diagonal().sqrt(), R.sqrt(), control=CONTROL, missing=0.3, **kwargs)
    return TransformedEnv(plain, DEnKFTransform(FixedLag(linear_kalman(control=CONTROL), LAG)))


@pytest.mark.parametrize("workers", [0, 2])
def test_clones_use_their_actions(workers):
    if workers:
        env = envs.forked_env(
            workers, controlled_env, create_env_kwargs=[{"max_steps": 4}, {"max_steps": 7, "seed": 1}]
        )
    else:
        env = controlled_env(batch_size=[2], max_steps=[4, 7])
    try:
        check_env_specs(env)
        rollout = TransformedEnv(env, InitTracker()).rollout(12, break_when_any_done=False)
    finally:
        env.close()
    assert rollout["smoothed", "age"][0, :6, 0].tolist() == [0, 1, 2, 2, 0, 1]
    frames = rollout.select("observation", "observed", "is_init", "action")
    online = FixedLag(linear_kalman(control=CONTROL), LAG).sequence(frames.copy())
    assert_equal(rollout, online, [*KEYS, ("smoothed", "cov")], atol=1e-4)
    whole = RTSSmoother(linear_kalman(control=CONTROL), LAG)(frames.copy())
    for row, t in (rollout["smoothed", "age"].squeeze(-1) == LAG).nonzero().tolist():
        now, then = rollout["smoothed", "mean"][row, t], whole["smoothed", "mean"][row, t - LAG]
        torch.testing.assert_close(now, then, rtol=0, atol=1e-4)
    without = RTSSmoother(linear_kalman(), LAG)(frames.exclude("action"))
    assert (without["smoothed", "mean"] - whole["smoothed", "mean"]).abs().max() > 0.1
