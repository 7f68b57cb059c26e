"""Oracles: unit vectors, and the same numbers on another turn."""

import math

import pytest
import torch

from torch_denkf.functional import wrap_angles
from torch_denkf.functional.manifolds import Circle, Euclidean, Flat

pytestmark = pytest.mark.usefixtures("float64")

FIRST = Flat(2, circular=[0])


def test_wrapped_differences_point_the_same_way_and_lie_within_half_a_turn():
    difference = 20 * torch.randn(50, 3)
    out = Flat(3, circular=[2, 0]).normalise(difference)
    assert out[:, 1].equal(difference[:, 1])
    for function in (torch.sin, torch.cos):
        torch.testing.assert_close(function(out), function(difference), rtol=0, atol=1e-12)
    assert (out[:, [0, 2]] >= -math.pi).all()
    assert (out[:, [0, 2]] < math.pi).all()
    edges = torch.tensor([-math.pi, 0.0, 3.0, -3.0, 2 * math.pi, 7.0]).unsqueeze(-1)
    expected = torch.tensor([-math.pi, 0.0, 3.0, -3.0, 0.0, 7.0 - 2 * math.pi]).unsqueeze(-1)
    torch.testing.assert_close(wrap_angles(edges), expected, rtol=0, atol=1e-14)
    assert Euclidean(3).normalise(difference) is difference


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("samples", [True, False])
def test_aligned_angles_do_not_depend_on_the_turns_they_came_in(batch, samples):
    predicted = torch.tensor([3.0, 5.0]) + 0.4 * torch.randn(*batch, 9, 2)
    reading = torch.tensor([-3.0, 5.0]) + 0.4 * torch.randn(*batch, *[7] * samples, 2)
    if samples:  # as many as members
        reading = reading[..., :1, :] + 0.1 * torch.randn(*batch, 9, 2)
    first = FIRST.align(predicted, reading)
    turns = [2 * math.pi * torch.randint(-3, 4, value.shape) for value in (predicted, reading)]
    moved = [value + turn * torch.tensor([1.0, 0.0]) for value, turn in zip((predicted, reading), turns, strict=True)]
    torch.testing.assert_close(FIRST.align(*moved), first, rtol=0, atol=1e-12)
    for value, aligned in zip((predicted, reading), first, strict=True):
        assert (aligned - value)[..., 1].abs().max() < 1e-14
        for function in (torch.sin, torch.cos):
            torch.testing.assert_close(function(aligned[..., 0]), function(value[..., 0]), rtol=0, atol=1e-12)
    # On one turn: like a line, with the reading on the shorter way round.
    spread = first[0][..., 0].amax(-1) - first[0][..., 0].amin(-1)
    assert (spread < math.pi).all()
    center = first[0][..., 0].mean(-1)
    own = first[1][..., 0].mean(-1) if samples else first[1][..., 0]
    assert ((own - center).abs() < math.pi).all()


def test_what_a_mask_hides_may_be_nan():
    predicted, reading = torch.randn(3, 5, 2), torch.full((3, 5, 2), torch.nan)
    reading[0] = 1.0
    observed = torch.tensor([[True], [False], [False]])
    for samples in (reading, reading[:, 0]):
        aligned = FIRST.align(predicted, samples, observed)
        assert all(value.isfinite().all() for value in aligned)
        torch.testing.assert_close(aligned[1][0], samples[0])
    assert Euclidean(2).align(predicted, reading)[0] is predicted


def test_the_mean_of_angles_is_that_of_deviations_from_their_direction():
    samples = torch.tensor([[3.0, 1.0], [-3.0, 2.0], [-3.1, 6.0]])
    expected = torch.tensor([(3.0 + (2 * math.pi - 3.0) + (2 * math.pi - 3.1)) / 3, 3.0])
    mean = FIRST.mean(samples)
    torch.testing.assert_close(mean.cos(), expected.cos(), rtol=0, atol=1e-12)
    torch.testing.assert_close(mean.sin(), expected.sin(), rtol=0, atol=1e-12)
    torch.testing.assert_close(mean[1], expected[1], rtol=0, atol=1e-12)
    assert Euclidean(2).mean(samples).equal(samples.mean(0))


def test_gradients_are_those_of_numbers_on_a_line():
    # The turn is a constant: the mean of a reading moves with each sample by 1/n.
    samples = (math.pi + 0.3 * torch.randn(6, 1)).requires_grad_()
    torch.testing.assert_close(
        torch.autograd.grad(Circle().mean(wrap_angles(samples)).sum(), samples)[0],
        torch.full((6, 1), 1 / 6),
        rtol=0,
        atol=1e-14,
    )
