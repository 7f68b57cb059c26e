"""Oracles: episodes that must be alike, actions and scores worked out by hand, and a sensor of known errors."""

import pandas as pd
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("dm_control", reason="dm_control is not installed: pip install dm-control 'mujoco<4'")

from benchmarks.arms.arms import ARMS
from benchmarks.arms.page import difference
from benchmarks.arms.study import scores


def test_the_controller_by_hand():
    """Only the first angle goes the short way round, and the arm is held as its goal needs it."""
    arm = ARMS["manipulator"]
    goal, angles = torch.tensor([3.0, 0.4, 2.5, 0.1]), torch.tensor([-3.0, 0.3, -1.0, 0.2])
    action = arm.control(arm.join(angles, torch.full((4,), 0.1)), goal)
    expected = arm.hold(goal) + 1.5 * torch.tensor([6.0 - 2 * torch.pi, 0.1, 3.5, -0.1]) - 0.15 * 0.1
    expected[2] = 1.0  # no action is more than full
    torch.testing.assert_close(action, torch.nn.functional.pad(expected, (0, 1)), atol=1e-5, rtol=0)


def test_scores_of_the_end_are_of_the_last_quarter():
    """The arm is at its goal there, and the belief in its tip errs to one side, then as far to the other."""
    arm, zero = ARMS["reacher"], torch.zeros(2, 8, 2)
    before = torch.arange(8) < 6
    state = arm.join(zero + 0.5 * before.unsqueeze(-1), zero)
    off = torch.tensor([0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.1, -0.1])
    held = arm.join(zero + torch.stack([off, 0 * off], -1), zero)
    data = TensorDict({"state": state, "held": held, "reward": torch.ones(2, 8, 1)}, [2, 8])
    episodes = TensorDict({"next": data, "goal": zero, "action": zero}, [2, 8])
    row, angle = scores(arm, episodes, "held")[0], torch.tensor(0.1)
    assert row["tip"] == pytest.approx(0.0, abs=1e-5)
    assert row["error"] == pytest.approx(2 * 24 * (angle / 2).sin().item(), rel=1e-4)  # of a link of 24 cm
    assert row["offset"] == pytest.approx(24 * (1 - angle.cos().item()), rel=1e-3)  # along it; across it is 0


def test_differences_are_of_the_same_episodes_in_any_order():
    angles = {"reading": {0: 1.0, 1: 5.0, 2: 3.0}, "belief": {2: 5.0, 1: 7.0, 0: 9.0}}
    rows = pd.DataFrame(
        {"seed": 0, "estimate": estimate, "episode": episode, "angle": angle}
        for estimate, each in angles.items()
        for episode, angle in each.items()
    )
    # They are 8, 2 and 2, and of three draws 4 % are all 8 and 30 % all 2.
    assert difference(rows, "angle") == "+4.00 [+2.00, +8.00], +133%"
