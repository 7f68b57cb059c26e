"""Oracles: circles; the wheels' study; a turned plane; poses in space that stay in the plane."""

import math

import pytest
import torch
from torch.testing import assert_close

from benchmarks.wheels import task
from tests.motions.steps_for_tests import random_points, step
from torch_denkf.functional.manifolds import SE2, SE3, SO3
from torch_denkf.motions import ConstantTwist, PlanarMotion

pytestmark = pytest.mark.usefixtures("float64")


@pytest.mark.parametrize("turn", [0.0, 1e-6, 0.3, -2.0])
def test_a_circle(turn):
    start = torch.tensor([[0.4, 1.0, 2.0, 1.5, turn, 0.1, 0.9]])
    moved = step(PlanarMotion(2.0), start)[0]
    end = 0.4 + 2.0 * turn
    if abs(turn) < 1e-3:
        place = [1.0 + 3.0 * math.cos(0.4 + turn), 2.0 + 3.0 * math.sin(0.4 + turn)]
    else:
        place = [1.0 + 1.5 / turn * (math.sin(end) - math.sin(0.4)), 2.0 - 1.5 / turn * (math.cos(end) - math.cos(0.4))]
    expected = torch.tensor([math.remainder(end, 2 * math.pi), *place, 1.5, turn, 0.1, 0.9])
    assert_close(moved, expected, rtol=0, atol=1e-11)


def test_equals_the_unicycle_for_short_steps(monkeypatch):
    errors = []
    order = [2, 0, 1, 3, 4, 5, 6]  # heading first
    start = torch.tensor([0.1, 0.2, 0.3, 1.4, 0.5, 0.02, 1.1])
    for dt in (2e-3, 1e-3):
        monkeypatch.setattr(task, "DT", dt)
        motion, known = PlanarMotion(dt, damping=0.2, usual_speed=1.0), task.moved
        state, expected = start[order].unsqueeze(0), start
        for _ in range(round(1 / dt)):
            state, expected = step(motion, state), known(expected)
        errors.append((state[0] - expected[order]).norm().item())
    assert errors[0] < 2e-3
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.02)


def test_the_plane_turned_and_moved_gives_the_same_turned_and_moved():
    motion = PlanarMotion(0.7, damping=0.3, usual_speed=2.0)
    state, away = random_points(motion.space, 5, 4), random_points(SE2())

    def elsewhere(state):
        return torch.cat([SE2().compose(away.expand(5, 4, 3), state[..., :3]), state[..., 3:]], -1)

    difference = motion.space.minus(step(motion, elsewhere(state)), elsewhere(step(motion, state)))
    assert_close(difference, torch.zeros(5, 4, 7), rtol=0, atol=1e-13)


def test_a_twist_in_the_plane_is_one_in_space():
    twist = torch.randn(6, 3)
    flat = torch.cat([random_points(SE2(), 6), twist], -1)
    angle, place = flat[:, :1], flat[:, 1:3]
    zeros = torch.zeros(6, 1)
    turn = SO3().exp(torch.cat([zeros, zeros, angle], -1))
    full = torch.cat([turn, place, zeros, zeros, zeros, twist, zeros], -1)
    in_plane, in_space = step(ConstantTwist(SE2(), 0.9), flat), step(ConstantTwist(SE3(), 0.9), full)
    assert_close(in_space[:, 4:6], in_plane[:, 1:3], rtol=0, atol=1e-13)
    turned = SO3().exp(torch.cat([zeros, zeros, in_plane[:, :1]], -1))
    assert_close(SO3().distance(in_space[:, :4], turned), torch.zeros(6), rtol=0, atol=1e-12)
