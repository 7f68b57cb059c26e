"""The arm in torchrl's batched environments, collectors, and under a filter: each row is what it is alone."""

from functools import partial

import pytest
import torch
from torchrl.envs import ParallelEnv, SerialEnv, check_env_specs

from tests.envs.opengl import needs_opengl
from torch_denkf.applications.ur5 import UR5TableEnv
from torch_denkf.applications.ur5.envs.expert import UR5Expert

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
