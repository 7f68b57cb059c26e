"""The arm in torchrl's batched environments, collectors, and under a filter: each row is what it is alone."""

from functools import partial

import pytest
import torch
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv, check_env_specs

from tests.envs.opengl import needs_opengl
from torch_denkf.applications.ur5 import UR5TableEnv
from torch_denkf.applications.ur5.envs.expert import UR5Expert
from torch_denkf.filters import KalmanFilter
from torch_denkf.transforms import DEnKFTransform

OPTIONS = {"size": (16, 24), "max_steps": 6}
SEEDS = [{"seed": 3}, {"seed": 4}]


def alone():
    return torch.stack([UR5TableEnv("pick", **OPTIONS, **seed).rollout(6, UR5Expert()) for seed in SEEDS])


@pytest.mark.parametrize("kind", [SerialEnv, pytest.param(ParallelEnv, marks=pytest.mark.slow)])
def test_batched(kind):
    needs_opengl()
    env = kind(2, partial(UR5TableEnv, "pick", **OPTIONS), create_env_kwargs=SEEDS)
    try:
        rollout = env.rollout(6, UR5Expert())
        assert (rollout == alone()).all()
        check_env_specs(env)
        env.set_seed(0)
        start = env.reset()["state"]
        assert (start[0] != start[1]).any()
    finally:
        env.close()


def test_a_filter_on_the_state():
    # Readings almost without noise: the filter's mean is the state.
    one = torch.eye(10)
    filter_ = KalmanFilter(
        one,
        one,
        process_noise_cov=1e-2 * one,
        noise_cov=1e-8 * one,
        mean=torch.zeros(10),
        cov=one,
        observation_key="state",
    )
    env = TransformedEnv(UR5TableEnv("push", from_pixels=False, max_steps=20, seed=0), DEnKFTransform(filter_))
    check_env_specs(env)
    rollout = env.rollout(20, UR5Expert())
    torch.testing.assert_close(rollout["next", "belief", "mean"], rollout["next", "state"], atol=1e-3, rtol=0)
