"""Sensors, motion and filters of the UR5 study."""

import math

import pytest
import torch

from benchmarks.ur5.motion import Motion
from benchmarks.ur5.sensors import TurnedWrist, project, side_of, wrist_of
from tests.benchmarks.ur5_for_tests import FACTS, states
from torch_denkf.applications.ur5.simulation.domains import Domain

# ------------------------------------------------------------------------------------------------------ the wrist


def test_a_reading_of_the_turned_wrist_gives_the_state_back_from_any_angle_within_a_quarter_turn():
    state = states(200)
    state[:, 5] = torch.linspace(-5, 5, 200)
    reading = TurnedWrist()(state)
    torch.testing.assert_close(wrist_of(reading, state[:, 5] + 1.5), state, atol=1e-5, rtol=0)
    other = wrist_of(reading, state[:, 5] + math.pi)  # half a turn on it looks the same
    torch.testing.assert_close(other[:, 5], state[:, 5] + math.pi, atol=1e-5, rtol=0)


def test_a_clear_picture_decides_the_half_turn_and_an_open_one_leaves_it_to_the_forecast():
    state = states(50)
    state[:, 5] = torch.linspace(-3, 3, 50)
    reading = TurnedWrist()(state)
    for near in (state[:, 5] + 2.5, state[:, 5] - 2.5 + 2 * math.pi, state[:, 5] + 0.4):
        turns = (wrist_of(reading, side_of(reading, near))[:, 5] - state[:, 5]) / (2 * math.pi)
        torch.testing.assert_close(turns, turns.round(), atol=1e-5, rtol=0)  # the same angle, on the forecast's turn
        assert ((side_of(reading, near) - near).abs() < math.pi).all()
    torch.testing.assert_close(side_of(reading), state[:, 5])
    reading[:, 7:9] *= 0.2
    other = wrist_of(reading, side_of(reading, state[:, 5] + math.pi))[:, 5]
    torch.testing.assert_close(other, state[:, 5] + math.pi, atol=1e-5, rtol=0)


# ------------------------------------------------------------------------------------------------------ the motion


def test_the_place_follows_the_joints_and_keeps_a_share_of_its_difference():
    torch.manual_seed(0)
    motion = Motion(FACTS)
    state = torch.cat([states(6), 0.01 * torch.randn(6, 14)], -1)
    moved = motion(state)
    torch.testing.assert_close(moved[:, :7], state[:, :7] + moved[:, 10:17])
    damped, lasting = torch.tensor([6.0, 2.0]).sigmoid()
    torch.testing.assert_close(moved[:, 10:17], damped * state[:, 10:17] + lasting * state[:, 17:])  # before training
    torch.testing.assert_close(moved[:, 17:], moved[:, 10:17] - state[:, 10:17])
    expected = motion.place(moved[:, :7]) + 0.5 * (state[:, 7:10] - motion.place(state[:, :7]))
    torch.testing.assert_close(moved[:, 7:10], expected)


# ------------------------------------------------------------------------------------------------ sensors, filters


def test_places_project_as_a_pinhole_has_it():
    # The camera's target is in the middle; what is 1.58 m behind it, 0.1 m to the left of the arm, is on the right.
    assert project(torch.tensor([-0.18, 0.02, 0.27])).abs().max() < 1e-6
    right, low = project(torch.tensor([[-0.18, 0.12, 0.27], [-0.18, 0.02, 0.17]]))
    depth = math.dist((1.4, 0.0, 0.85), (-0.18, 0.02, 0.27)) * math.tan(math.radians(16.5))
    assert float(right[0]) == pytest.approx(0.1 / depth, rel=0.02)
    assert float(low[1]) > 0.15
    assert abs(float(low[0])) < 0.01
    # Another camera, from above: its target is in the middle, too.
    above = Domain(camera=(-0.1, 0.02, 2.0), target=(-0.2, 0.0, 0.1), field=40.0)
    assert project(torch.tensor([-0.2, 0.0, 0.1]), above).abs().max() < 1e-6
