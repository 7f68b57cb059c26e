"""The study of a policy on a belief: its robots, what the arms read, its scores."""

from dataclasses import replace

import mujoco
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from benchmarks.legged.policy import (
    ARMS,
    GAIT,
    INPUT,
    READ,
    SCALE,
    SPREAD,
    TRUE,
    TRUTH,
    Laboratory,
    Study,
    page,
    scored,
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


def test_commands_and_forces_are_the_same_for_all_arms(laboratory):
    one, other = (played(laboratory, TRUTH, forwards=value) for value in (0.0, 1.0))
    assert torch.equal(one["command"], other["command"])
    assert torch.equal(one["imu"][:, 0], other["imu"][:, 0])
    assert not torch.equal(one["next", TRUE], other["next", TRUE])
    assert (one["command"][0] != one["command"][1]).any()


def test_the_reward_is_that_of_the_true_velocity(laboratory):
    data = played(laboratory, TRUTH)
    wrong = (data["next", TRUE][..., :2] - data["command"]).square().sum(-1)
    bound = (-wrong / 0.15**2).exp()
    assert (data["next", "reward"][..., 0] <= bound + 1e-5).all()  # less where the base turns
    assert (data["next", "reward"][..., 0] > 0.8 * bound).all()


def test_arms_read_the_same_but_for_the_velocity(laboratory):
    found = {arm: played(laboratory, arm) for arm in ARMS}
    for arm in ("zero", "LSTM", "belief"):
        assert torch.equal(found[arm][INPUT][..., 3:], found["belief"][INPUT][..., 3:])
    assert (found[TRUTH][INPUT] - found["belief"][INPUT])[..., 3:6].abs().max() < 0.05  # up, by the filter
    assert torch.equal(found[TRUTH][INPUT][..., :3], found[TRUTH][TRUE])
    assert torch.equal(found["belief"][INPUT][..., :3], found["belief"][VELOCITY])
    assert found["zero"][INPUT][..., :3].abs().max() == 0
    assert found[SPREAD][INPUT].shape[-1] == len(SCALE) + 3
    assert torch.equal(found[SPREAD][INPUT][..., : len(SCALE)], found["belief"][INPUT])


def test_the_network_estimates_row_by_row_what_it_does_on_a_whole_log(laboratory):
    data = played(laboratory, "LSTM")
    log = torch.cat([data[:, :1].select(*READ), data["next"].select(*READ)], 1)
    with torch.no_grad():
        whole = laboratory.network(laboratory.network.read(log))[0]
    assert (data["next", INPUT][..., :3] - whole[:, 1:]).abs().max() < 1e-5


def test_an_action_gets_the_rewards_until_the_next_one():
    rows = TensorDict({INPUT: torch.arange(10.0).reshape(1, 10, 1)}, [1, 10])
    rows["next"] = TensorDict({INPUT: rows[INPUT] + 1, "reward": rows[INPUT]}, [1, 10])
    data = acted(rows)
    assert data[INPUT].flatten().tolist() == [0, EVERY]
    assert data["next", INPUT].flatten().tolist() == [EVERY, 10]
    assert data["next", "reward"].flatten().tolist() == [2, 7]


def test_scores_and_page():
    after = {"true": {"velocity": torch.tensor([0.3, 0.4, 0.0]), "orientation": torch.tensor([1.0, 0, 0, 0])}}
    after = {**after, INPUT: torch.tensor([0.0, 0.4, 0.4]), "reward": torch.ones(1)}
    data = TensorDict({"next": after, "command": torch.zeros(2)}).expand(3, 100)
    found = scored(data)
    assert {key: value.tolist() for key, value in found.items()} == {
        "return": [1.0] * 3,
        "error": pytest.approx([0.5] * 3),
        "falls": [0.0] * 3,
        "off": pytest.approx([0.5] * 3),
    }
    rows = [{"ground": GROUND, "arm": TRUTH, **{key: value[0].item() for key, value in found.items()}}] * 3
    half = [{**row, "arm": "zero", "return": 0.5, "falls": 1.0} for row in rows]
    text = page(rows + half, Study())
    assert "| truth | 1.00 | 100.0 ± 0.0 | 0.500 | 0.500 | 0 of 3 |" in text
    assert "| zero | 0.50 | 50.0 ± 0.0 | 0.500 | 0.500 | 3 of 3 |" in text
