"""The action that led to an observation: in the same row, zero after a reset, in every kind of environment."""

import torch
from torchrl.envs import SerialEnv, TransformedEnv

from tests.filters.composed import ReplayedFrames, frames_for
from tests.transforms.envs_for_tests import base_env
from torch_denkf.transforms import LastAction


def test_last_action_is_zero_after_a_reset(float64):
    frames = frames_for(["resets"])
    env = ReplayedFrames(frames)
    player = env.player()
    rollout = TransformedEnv(env, LastAction()).rollout(9, player, break_when_any_done=False)
    expected = torch.cat([torch.zeros(3, 1, 2), frames["action"][:, :-1]], 1)
    expected = torch.where(frames["is_init"], 0.0, expected)
    assert rollout["previous", "action"].equal(expected)
    assert rollout["next", "previous", "action"].equal(rollout["action"])


def test_workers_have_their_own():
    def make(seed):
        return lambda: TransformedEnv(base_env(seed=seed), LastAction())

    env = SerialEnv(2, [make(0), make(1)])
    rollout = env.rollout(4)
    assert rollout["previous", "action"][:, 1:].equal(rollout["action"][:, :-1])
    assert (rollout["previous", "action"][:, 0] == 0).all()
