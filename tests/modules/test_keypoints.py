"""Oracles: a Gaussian bump whose place is known, sums by hand, and a task that a keypoint solves."""

import pytest
import torch

from torch_denkf.modules.keypoints import SpatialSoftArgmax


def bump(column, row, height=24, width=36, sigma=2.0):
    """-(distance / sigma)^2 / 2 in pixels: its softmax is a Gaussian about the place, in pixels."""
    rows, columns = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return -((columns - column) ** 2 + (rows - row) ** 2) / (2 * sigma**2)


def test_keypoint_of_a_bump(float64):
    places = [(18.0, 12.0), (10.25, 9.5), (25.5, 14.0)]
    features = torch.stack([bump(*place) for place in places]).unsqueeze(0)
    out = SpatialSoftArgmax(3)(features)[0]
    # The bump is five sigma or so from the borders: what is cut off moves its mean by 1e-5.
    for number, (column, row) in enumerate(places):
        assert float(out[number]) == pytest.approx(2 * column / 35 - 1, abs=1e-4)
        assert float(out[3 + number]) == pytest.approx(2 * row / 23 - 1, abs=1e-4)


def test_soft_argmax_is_the_weighted_sum(float64):
    features = torch.randn(2, 3, 4, 5)
    module = SpatialSoftArgmax(3)
    with torch.no_grad():
        module.log_sharpness.copy_(torch.tensor([[0.0], [0.7], [-1.0]]))
    out = module(features)
    for n in range(2):
        for c in range(3):
            weights = (features[n, c] * module.log_sharpness[c].exp()).exp()
            weights = weights / weights.sum()
            column = sum(float(weights[i, j]) * (j / 2 - 1) for i in range(4) for j in range(5))
            row = sum(float(weights[i, j]) * (2 * i / 3 - 1) for i in range(4) for j in range(5))
            assert float(out[n, c]) == pytest.approx(column)
            assert float(out[n, 3 + c]) == pytest.approx(row)
    assert torch.autograd.gradcheck(module, features.requires_grad_())
