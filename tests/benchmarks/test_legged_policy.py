"""The study of a policy on a belief: its robots, what the arms read, its scores."""

from dataclasses import replace

import mujoco
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
from benchmarks.legged.walk import EVERY, acted, gait, play
from torch_denkf.applications.legged import QUADRUPED, LearnedContacts, quadruped_env
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.functional.manifolds import rotate

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


def feet_of(controls):
    """Where feet go under constant controls, where nothing weighs, in the base's axes ``[4, 3]``."""
    robot = quadruped_env(seed=0)
    robot.reset()
    robot.model.opt.gravity[:] = 0
    robot.data.qpos[2] = 5
    robot.data.ctrl[:] = controls.numpy()
    mujoco.mj_step(robot.model, robot.data, 1200)
    columns = torch.tensor(robot.data.qpos[robot.columns], dtype=torch.float32)
    kinematics = LegKinematics(robot.model, **QUADRUPED)
    return rotate(kinematics.base[:4], kinematics(columns))


@pytest.mark.parametrize("stride", [[0.06, 0.0, 0.0], [0.0, 0.06, 0.0]])
def test_feet_go_as_far_as_the_stride_says(stride):
    """By the simulator: at the beginning of a stance, two feet are ahead, and the other two behind."""
    stride = torch.tensor(stride)
    moved = feet_of(gait(torch.zeros(1), stride)) - feet_of(gait(torch.zeros(1), torch.zeros(3)))
    wanted = torch.tensor([[1.0], [-1.0], [1.0], [-1.0]]) * stride
    assert (moved - wanted)[:, :2].abs().max() < 0.015


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
