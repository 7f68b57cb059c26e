"""Oracles: flows of points at random depths, by finite motion; rendered drives, whose motion is known."""

import cv2
import numpy as np
import pytest
import torch

from torch_denkf.applications.car.vision.expansion import focus_of_expansion
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE


def cells():
    columns, rows = ((torch.arange(n) + 0.5) / n * 2 - 1 for n in (79, 25))
    y, x = torch.meshgrid(rows * 0.2708, columns * 0.8625, indexing="ij")
    return x, y


def flow_of(focus, turn, nearness):
    """By finite motion: a point that is seen now is moved to where the older camera saw it, and projected there."""
    x, y = cells()
    now = torch.stack([x, y, torch.ones_like(x)]) / nearness
    left, up, around = turn
    # cv2 turns points: x is to the right, y down, and a camera that turns to the left moves them to the right.
    rotation, _ = cv2.Rodrigues(np.array([-up, left, around]))
    before = torch.einsum("ji,jhw->ihw", torch.as_tensor(rotation), now) + torch.tensor([*focus, 1.0])[:, None, None]
    return torch.stack([x - before[0] / before[2], y - before[1] / before[2], torch.zeros_like(x)])


@pytest.mark.parametrize("focus", [(0.0, 0.0), (0.1, -0.03), (-0.04, 0.02)])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.002, -0.001, 0.001), (-0.002, 0.001, -0.002)])
def test_finds_the_motion_of_points_at_any_depth(float64, focus, turn):
    found = focus_of_expansion(flow_of(focus, turn, 0.02 + 0.3 * torch.rand(25, 79)).unsqueeze(0))
    # The model is one of small motions: the focus itself turns by 0.002, and so does the flow of a tenth.
    torch.testing.assert_close(found.focus[0], torch.tensor(focus), rtol=0, atol=3e-3)
    torch.testing.assert_close(found.turn[0], torch.tensor(turn), rtol=0, atol=4e-4)


def test_moving_objects_are_ignored(float64):
    """A car over a tenth of the picture, and a corner that is not trusted."""
    flow = flow_of((0.02, -0.02), (0.003, 0.0, 0.0), 0.02 + 0.1 * torch.rand(25, 79))
    clean = focus_of_expansion(flow.unsqueeze(0))
    flow[0, 8:20, 30:47] += 0.03
    flow[:2, :6, :20] = torch.randn(2, 6, 20)
    flow[2, :6, :20] = 1.0
    found = focus_of_expansion(flow.unsqueeze(0))
    torch.testing.assert_close(found.focus, clean.focus, rtol=0, atol=2e-3)
    torch.testing.assert_close(found.turn, clean.turn, rtol=0, atol=2e-4)


def test_covariance_is_large_at_standstill(float64):
    found = focus_of_expansion(torch.zeros(2, *FLOW_SHAPE))
    torch.testing.assert_close(found.focus, torch.tensor([[0.0, -0.01]] * 2))
    torch.testing.assert_close(found.focus_std, torch.tensor([[0.06, 0.05]] * 2), rtol=0.05, atol=0)
    torch.testing.assert_close(found.turn, torch.zeros(2, 3))
    assert (found.turn_std < 0.01).all(), "that it does not turn can be seen"
