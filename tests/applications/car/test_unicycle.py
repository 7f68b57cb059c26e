"""Oracles: complex numbers, a circle, and automatic differentiation."""

import math

import pytest
import torch

from torch_denkf.applications.car import dead_reckoning
from torch_denkf.applications.car.unicycle import unicycle_jacobians, unicycle_move


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_moves_are_those_of_complex_numbers_and_their_own_inverse(float64, batch):
    pose, velocity = torch.randn(*batch, 3), torch.randn(*batch, 2)
    moved = unicycle_move(pose, velocity, 0.3)
    direction = torch.polar(torch.ones(batch), pose[..., 2] + 0.15 * velocity[..., 1])
    place = torch.complex(pose[..., 0], pose[..., 1]) + 0.3 * velocity[..., 0] * direction
    expected = torch.stack([place.real, place.imag, pose[..., 2] + 0.3 * velocity[..., 1]], -1)
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(unicycle_move(moved, velocity, -0.3), pose, rtol=0, atol=1e-14)


def test_an_even_turn_closes_its_circle_and_is_dead_reckoning(float64):
    velocity = torch.tensor([7.0, 2 * math.pi / 5]).expand(51, 2)  # a circle in 5 s
    poses = [torch.tensor([1.0, 2.0, 0.4])]
    for step in velocity[1:]:
        poses.append(unicycle_move(poses[-1], step, 0.1))
    torch.testing.assert_close(poses[-1][:2], poses[0][:2], rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.stack(poses), dead_reckoning(velocity, poses[0], 0.1), rtol=0, atol=1e-12)


def test_jacobians_are_those_of_automatic_differentiation(float64):
    poses, velocities = torch.randn(5, 3), torch.randn(5, 2)
    by_pose, by_velocity = unicycle_jacobians(poses, velocities, 0.3)
    for row in range(5):
        expected = torch.autograd.functional.jacobian(
            lambda pose, velocity: unicycle_move(pose, velocity, 0.3), (poses[row], velocities[row])
        )
        torch.testing.assert_close((by_pose[row], by_velocity[row]), expected, rtol=0, atol=1e-14)
