"""A system that stays near the neutral rotation, and the linear one that it is in the limit."""

import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.test_spaces import DT, SPACE, STD, B, Orientation, Q, R, T, Turning
from torch_denkf.functional.manifolds import SO3
from torch_denkf.modules import ConstantNoise, LearnedTransition, Select

SMALL = 1e-3  # of what the angles are elsewhere: products of two are a millionth
STARTS, PROCESS = [SMALL * std for std in STD], [SMALL * std for std in Q]


def noise():
    """R."""
    return ConstantNoise([SMALL * std for std in R], in_key="pose")


def rotating():
    """Returns the motion, sensor, observation."""
    return Turning(), None, Orientation()


def linear():
    """Returns the same of plain numbers."""
    move = nn.Linear(6, 6, bias=False)
    move.weight.data = torch.eye(6)
    move.weight.data[:3, 3:] = -DT * torch.eye(3)
    return LearnedTransition(move, residual=False), None, Select([0, 1, 2])


def readings(spread=1.0):
    """Data of both; readings lie ``spread`` times a thousandth of a rad from the neutral rotation."""
    torch.manual_seed(0)
    tangents, observed = SMALL * spread * torch.randn(B, T, 3), torch.rand(B, T, 1) < 0.8
    data = TensorDict({"pose": SO3().exp(tangents), "action": torch.zeros(B, T, 3), "observed": observed}, [B, T])
    data["start"] = SPACE.neutral(tangents).expand(B, T, 7).clone()
    flat = TensorDict({"pose": tangents, "start": torch.zeros(B, T, 6), "observed": observed}, [B, T])
    return data, flat


def assert_small_differences(out, expected, key, start, var=0.01):
    """Means agree to a hundredth of what angles are, variances to the hundredth part."""
    away = SPACE.minus(out[key, "mean"], start)
    assert (away - expected[key, "mean"]).abs().max() < 1e-2 * SMALL
    assert (out[key, "var"] / expected[key, "var"] - 1).abs().max() < var
