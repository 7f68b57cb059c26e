"""The forms that a GPU takes, run on a processor: beliefs and gradients are equal."""

import pytest
import torch

from benchmarks.speed.workload import make_filter, make_frames
from tests.filters.factories import assert_equal, toy_denkf, toy_frames
from tests.filters.test_contract import every_filter, with_noise
from torch_denkf.beliefs import Ensemble
from torch_denkf.functional.kernels import small_system
from torch_denkf.functional.kernels.random_bits import dropout_factor


@pytest.fixture
def gpu(monkeypatch):
    """Returns a function that turns a GPU's forms on, on a processor."""
    return lambda: monkeypatch.setattr(small_system, "GPUS", ("cuda", "cpu"))


@every_filter
def test_filters_agree_with_the_cpu(float64, gpu, name):
    filter, frames = with_noise(name, 3, 6, width=2)
    outs = []
    for turn in (lambda: None, gpu):
        turn()
        data = frames.copy()
        data["observation"] = leaf = frames["observation"].clone().requires_grad_()
        out = filter.sequence(data)
        step = filter.step(frames[:, 1].copy().update(out[:, 0].select(*filter.carry_keys)))
        outs.append((out, step, torch.autograd.grad(out["belief", "mean"].square().sum(), leaf)[0]))
    (out, step, gradient), (ours, our_step, our_gradient) = outs
    assert_equal(ours, out, filter.out_keys, atol=1e-9)
    assert_equal(our_step, step, filter.belief_keys, atol=1e-9)
    torch.testing.assert_close(our_gradient, gradient, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "draw"),
    [(toy_denkf, lambda: toy_frames((2, 6))), (make_filter, lambda: make_frames(2, 6))],
    ids=["toy", "workload"],
)
def test_gradients_of_all_parameters(float64, gpu, make, draw):
    filter = make().double()
    frames = filter.draw_noise(draw().apply(lambda value: value.double() if value.is_floating_point() else value))
    found = []
    for turn in (lambda: None, gpu):
        turn()
        filter.zero_grad()
        loss = filter.sequence(frames.copy())["belief", "mean"].square().sum()
        loss.backward(retain_graph=True)
        first = [p.grad.clone() for p in filter.parameters() if p.grad is not None]
        loss.backward()  # once more, which doubles them
        second = [p.grad for p in filter.parameters() if p.grad is not None]
        for one, two in zip(first, second, strict=True):
            torch.testing.assert_close(two, 2 * one)
        found.append(first)
    for theirs, ours in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("rate", [1 / 256, 26 / 256, 0.5, 255 / 256])
def test_dropout_keeps_the_same_units(gpu, rate):
    draws = torch.arange(256, dtype=torch.uint8)
    expected = dropout_factor(draws, rate, torch.float32)
    gpu()
    assert dropout_factor(draws, rate, torch.float32).equal(expected)


def test_a_ceiling_moves_the_same_members(float64, gpu):
    ensemble = torch.randn(3, 8, 2) * torch.tensor([1.0, 1e5]) + torch.tensor([3.0, 1e9])
    kind = Ensemble()
    held = {"ensemble": ensemble, "mean": ensemble.mean(-2), "var": ensemble.var(-2)}
    expected = kind.limited(held, 1e4)
    gpu()
    ours = kind.limited(held, 1e4)
    for name, value in expected.items():
        torch.testing.assert_close(ours[name], value, rtol=1e-12, atol=1e-6)
    assert ours["ensemble"][..., 0].equal(ensemble[..., 0])  # what is within the ceiling keeps all its digits
