"""Attitudes from one reading of gravity and field, and zero velocity."""

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.functional.manifolds import SO3
from torch_denkf.motions import Gravity, Magnetic
from torch_denkf.motions.standing import attitude_of, stands_still

FIELD = [0.0, 20.0, -40.0]


def test_an_attitude_is_the_one_at_which_the_sensors_read_so(float64):
    """The models of the sensors are the oracle, at 200 attitudes and at half turns."""
    turns = torch.cat([torch.randn(200, 3), torch.pi * torch.eye(3), torch.zeros(1, 3)])
    true = SO3().exp(turns)
    td = TensorDict({("forecast", "ensemble"): true.unsqueeze(-2)}, [len(true)])
    key = ("forecast", "observation")
    gravity, field = Gravity(SO3())(td.copy())[key].squeeze(-2), Magnetic(SO3(), FIELD)(td.copy())[key].squeeze(-2)
    found = attitude_of(gravity, field)
    torch.testing.assert_close(SO3().minus(found, true), torch.zeros(len(true), 3), rtol=0, atol=1e-7)


def test_declination_turns_north(float64):
    """A field that points 0.1 rad east of north: the body that reads it ahead looks there."""
    north = torch.tensor([torch.pi / 2 - 0.1]).sin().item()
    read = torch.tensor([20.0, 0.0, -40.0])  # along x of the body
    attitude = attitude_of(torch.tensor([0.0, 0.0, 9.81]), read, declination=0.1)
    ahead = SO3().minus(attitude, SO3().neutral().to(attitude))
    assert ahead[2] == pytest.approx(torch.pi / 2 - 0.1, abs=1e-9)
    assert north < 1


def test_without_a_field_the_slope_alone_is_known(float64):
    for turn in ([0.3, 0.0, 0.0], [0.0, -0.4, 0.0], [0.0, 1.5, 0.0]):
        true = SO3().exp(torch.tensor(turn))
        td = TensorDict({("forecast", "ensemble"): true.unsqueeze(0)})
        gravity = Gravity(SO3())(td)["forecast", "observation"][0]
        seen = TensorDict({("forecast", "ensemble"): attitude_of(gravity).unsqueeze(0)})
        torch.testing.assert_close(Gravity(SO3())(seen)["forecast", "observation"][0], gravity)


def test_standstill_detection():
    rate, force = 0.01 * torch.randn(2, 50, 3), 9.81 + 0.05 * torch.randn(2, 50, 3)
    force[0, 20], rate[1, 30] = 11.0, 0.5
    still = stands_still(rate, force, window=2, rate_noise=0.01, acceleration_noise=0.05).squeeze(-1)
    expected = torch.ones(2, 50, dtype=torch.bool)
    expected[0, 18:23], expected[1, 28:33] = False, False
    assert (still == expected).float().mean() > 0.97
    assert not still[0, 18:23].any()
    assert not still[1, 28:33].any()
