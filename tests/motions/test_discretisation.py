"""Steps of any length: the closed form of a body that white noise accelerates, and small steps put together."""

import torch
from torch.testing import assert_close

from torch_denkf.motions.discretisation import discretise

DRIFT = [[0.0, 1.0], [0.0, 0.0]]


def test_a_body_that_white_noise_accelerates(float64):
    dt = torch.tensor([[0.0], [0.02], [3.0]])
    motion, noise = discretise(torch.tensor(DRIFT), torch.diag(torch.tensor([0.0, 0.7])), dt)
    t = dt.flatten()
    one, zero = torch.ones_like(t), torch.zeros_like(t)
    assert_close(motion, torch.stack([one, t, zero, one], -1).reshape(3, 2, 2), rtol=0, atol=1e-12)
    expected = 0.7 * torch.stack([t**3 / 3, t**2 / 2, t**2 / 2, t], -1).reshape(3, 2, 2)
    assert_close(noise, expected, rtol=0, atol=1e-12)


def test_two_steps_are_one(float64):
    drift, root = torch.randn(3, 3), torch.randn(3, 3)
    density = root @ root.mT
    parts = [discretise(drift, density, torch.tensor([dt])) for dt in (0.3, 0.5, 0.8)]
    (first, first_noise), (second, second_noise), (whole, whole_noise) = parts
    assert_close(second @ first, whole, rtol=0, atol=1e-10)
    assert_close(second @ first_noise @ second.mT + second_noise, whole_noise, rtol=0, atol=1e-10)
