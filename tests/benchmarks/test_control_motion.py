"""Compares with values by hand: how a cart starts, when its episode ends, and the motion that its filter learns."""

import math

import pytest
import torch
from torch import nn

from benchmarks.control import cartpole


class Says(nn.Module):
    """A network that says the same of all states."""

    def __init__(self, *values):
        super().__init__()
        self.values = torch.tensor(values)

    def forward(self, features):
        return self.values.expand(*features.shape[:-1], -1)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        # Position, angle and two velocities. The cart gets 0.1 + 0.8 * 0.5 = 0.5 m/s more, the pole
        # -0.2 - 1.5 * 0.4 = -0.8 rad/s; both move for 0.04 s with the mean of their old and new velocities.
        ((0.5, 0.3, 2.0, 3.0), (0.5 + 0.04 * 2.25, 0.3 + 0.04 * 2.6, 2.5, 2.2)),
        # 1.84 m, outwards with 2.5 m/s: the cart stops, and the pole gets -1.5 * -2.5 rad/s more: 5.95.
        ((1.75, 0.3, 2.0, 3.0), (1.84, 0.3 + 0.04 * 4.475, 0.0, 5.95)),
        # -1.856 m, outwards with -2.4 m/s: the pole gets -1.5 * 2.4 rad/s more: -1.4.
        ((-1.75, 0.3, -2.9, 3.0), (-1.856, 0.3 + 0.04 * 0.8, 0.0, -1.4)),
        # 1.87 m and -1.85 m, inwards with -0.5 m/s and 1.5 m/s: nothing stops the cart.
        ((1.9, 0.3, -1.0, 3.0), (1.87, 0.3 + 0.04 * 2.6, -0.5, 2.2)),
        ((-1.9, 0.3, 1.0, 3.0), (-1.85, 0.3 + 0.04 * 2.6, 1.5, 2.2)),
    ],
    ids=["inside", "right end", "left end", "back from the right", "back from the left"],
)
def test_velocities_move_the_cart_and_the_pole(before, after):
    push = cartpole.Push()
    push.module = Says(0.1, -0.2, 0.8, -1.5)
    before, after = (
        torch.tensor([[[position, math.cos(angle), math.sin(angle), *velocities]]])
        for position, angle, *velocities in (before, after)
    )
    torch.testing.assert_close(push.compute(before, torch.tensor([[0.5]])), after, atol=1e-6, rtol=1e-6)
