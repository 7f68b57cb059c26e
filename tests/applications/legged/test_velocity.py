"""The base's velocity by its inertial sensor: against a moving rigid body, and a linearisation by autograd."""

import pytest
import torch

from torch_denkf.applications.legged.motion import LeggedSpace
from torch_denkf.applications.legged.velocity import BaseVelocity, base_velocity, base_velocity_of_moments
from torch_denkf.functional.manifolds import SO3, rotate

FEET = 2


@pytest.fixture(autouse=True)
def _double(float64):
    torch.manual_seed(0)


def sensor():
    return torch.cat([SO3().exp(torch.tensor([0.5, -0.8, 0.3])), torch.tensor([0.2, -0.1, 0.3])])


def states(count=5):
    state = torch.randn(count, 16 + 3 * FEET)
    state[..., :4] = SO3().exp(torch.randn(count, 3))
    return state


def test_velocity_is_in_body_axes():
    """The base's pose by that of its sensor, a moment before and after: central differences."""
    state, gyro, pose = states(), torch.randn(5, 3), sensor()

    def base(time):
        turn = SO3().plus(state[..., :4], time * (gyro - state[..., 10:13]))  # of the sensor
        place = state[..., 7:10] + time * state[..., 4:7]
        turn = SO3().compose(turn, SO3().inverse(pose[:4]).expand_as(turn))  # of the base
        return turn, place - rotate(turn, pose[4:].expand_as(place))

    (turn, _), (_, after), (_, before) = base(0.0), base(1e-5), base(-1e-5)
    expected = rotate(SO3().inverse(turn), (after - before) / 2e-5)
    torch.testing.assert_close(base_velocity(state, gyro, pose), expected, rtol=0, atol=1e-8)


def test_variance_equals_linearisation():
    """Maps a covariance in which velocity and bias are correlated: a wrong sign of the lever shows in that alone."""
    state, gyro, pose, space = states(), torch.randn(5, 3), sensor(), LeggedSpace(FEET)
    root = torch.randn(5, space.tangent_dim, space.tangent_dim)
    cov = root @ root.mT
    mean, var = base_velocity_of_moments(state, cov, gyro, pose)
    torch.testing.assert_close(mean, base_velocity(state, gyro, pose))
    for row in range(5):

        def moved(tangent, row=row):
            return base_velocity(space.plus(state[row], tangent), gyro[row], pose)

        jacobian = torch.autograd.functional.jacobian(moved, torch.zeros(space.tangent_dim))
        expected = (jacobian @ cov[row] @ jacobian.T).diagonal()
        torch.testing.assert_close(var[row], expected, rtol=1e-9, atol=1e-12)


def test_the_gyros_noise_counts_by_the_lever():
    """Readings of one state: the variance of the velocity over draws of the gyro's white noise."""
    pose, std = sensor(), 0.1
    module = BaseVelocity(pose, std, ensemble=False)
    state, gyro = states(1), torch.randn(1, 3)
    imu = torch.cat([gyro, torch.zeros(1, 3)], -1)
    _, var = module.compute(imu, state, torch.zeros(1, 15 + 3 * FEET, 15 + 3 * FEET))
    draws = base_velocity(state, gyro + std * torch.randn(200000, 3), pose)
    torch.testing.assert_close(draws.var(0, keepdim=True), var, rtol=0.02, atol=0)
