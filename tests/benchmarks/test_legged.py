"""The study of a legged robot's base: its scores against made-up beliefs, its data, its page."""

import pytest
import torch

from benchmarks.legged.task import FIRM, scores, simulated
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.functional.manifolds import SO3, rotate


@pytest.fixture(scope="module")
def robot():
    return simulated("quadruped", 2, 1.5, 0, FIRM)


def true_mean(robot):
    """Returns a belief that holds the truth, of the sensor on the base; feet are zero."""
    true, sensor = robot.log["true"], LegKinematics(robot.model, **robot.names).base
    turn = SO3().compose(true["orientation"], sensor[:4].expand_as(true["orientation"]))
    place = true["position"] + rotate(true["orientation"], sensor[4:])
    zero = torch.zeros_like(place)
    return torch.cat([turn, zero, place, zero, zero, zero, zero, zero, zero], -1)


def test_errors_are_counted(robot):
    torch.manual_seed(0)
    velocity = robot.log["true", "velocity"]
    std = torch.tensor([0.1, 0.2, 0.3])
    found = scores(robot, velocity + std * torch.randn_like(velocity), std.square().expand_as(velocity))
    assert found["velocity"] == pytest.approx(0.14**0.5, rel=0.1)
    assert found["nees"] == pytest.approx(1, rel=0.15)
    assert found["held"] == pytest.approx(0.9, abs=0.05)
    too_sure = scores(robot, velocity + std * torch.randn_like(velocity), (std / 2).square().expand_as(velocity))
    assert too_sure["nees"] == pytest.approx(4, rel=0.15)


def test_a_turned_belief_tilts_and_drifts(robot):
    mean = true_mean(robot)
    turn = SO3().exp(torch.tensor([0.1, 0.0, 0.0]))
    mean[..., :4] = SO3().compose(turn.expand(*mean.shape[:-1], 4), mean[..., :4])
    velocity = robot.log["true", "velocity"]
    assert scores(robot, velocity, torch.ones_like(velocity), mean)["tilt"] == pytest.approx(5.73, rel=0.02)
    # What begins elsewhere, with another heading, does not drift: the way counts from there.
    heading = SO3().exp(torch.tensor([0.0, 0.0, 1.0]))
    moved = true_mean(robot)
    moved[..., :4] = SO3().compose(heading.expand(*moved.shape[:-1], 4), moved[..., :4])
    moved[..., 7:10] = rotate(heading, moved[..., 7:10]) + 3
    found = scores(robot, velocity, torch.ones_like(velocity), moved)
    assert found["drift"] < 0.01
    assert found["tilt"] < 0.1
