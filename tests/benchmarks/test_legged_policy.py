"""The study of a policy on a belief: its robots, what the arms read, its scores."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from benchmarks.legged.policy import (
    GAIT,
    INPUT,
    READ,
    TRUE,
    TRUTH,
    Laboratory,
    Study,
)
from benchmarks.legged.training import LSTM, VELOCITY
from benchmarks.legged.walk import EVERY, acted, play
from torch_denkf.applications.legged import QUADRUPED, LearnedContacts

GROUND = "ground of the training"


@pytest.fixture(scope="module")
def laboratory():
    torch.manual_seed(0)
    laboratory = Laboratory(replace(Study(), robots=2))
    laboratory.network = LSTM(LearnedContacts(laboratory.model, **QUADRUPED, rows=5))
    return laboratory


def still(forwards=0.0):
    action = torch.tensor([forwards, 0.0, 0.0])
    return TensorDictModule(lambda command: action.expand(*command.shape[:-1], 3), ["command"], ["action"])


def played(laboratory, arm, rows=20, forwards=0.0):
    keep = [*READ, "true", "command", INPUT, *([] if arm in (TRUTH, GAIT) else [VELOCITY])]
    return play(laboratory.env(arm, GROUND, 3), still(forwards), rows, keep)


def test_the_reward_is_that_of_the_true_velocity(laboratory):
    data = played(laboratory, TRUTH)
    wrong = (data["next", TRUE][..., :2] - data["command"]).square().sum(-1)
    bound = (-wrong / 0.15**2).exp()
    assert (data["next", "reward"][..., 0] <= bound + 1e-5).all()  # less where the base turns
    assert (data["next", "reward"][..., 0] > 0.8 * bound).all()


def test_an_action_gets_the_rewards_until_the_next_one():
    rows = TensorDict({INPUT: torch.arange(10.0).reshape(1, 10, 1)}, [1, 10])
    rows["next"] = TensorDict({INPUT: rows[INPUT] + 1, "reward": rows[INPUT]}, [1, 10])
    data = acted(rows)
    assert data[INPUT].flatten().tolist() == [0, EVERY]
    assert data["next", INPUT].flatten().tolist() == [EVERY, 10]
    assert data["next", "reward"].flatten().tolist() == [2, 7]
