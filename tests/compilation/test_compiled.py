"""Compiled steps and chunks: the oracle is the same filter, eager, on the same noise."""

import pickle
from itertools import pairwise

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import (
    Perturbed,
    has_compiler,
    linear_denkf,
    linear_kalman,
    random_draws,
    toy_denkf,
    toy_frames,
)
from torch_denkf.modules import EnsembleAnalysis, LearnedObservation, MomentPrior, StochasticMLP

#: float32: a few roundings through eight steps; float64 likewise.
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-12}


def assert_close(ours, theirs, keys, dtype):
    for key in keys:
        torch.testing.assert_close(ours.get(key), theirs.get(key), rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", [pytest.param(torch.float32, marks=pytest.mark.slow), torch.float64])
def test_compiled_is_eager_forward_and_backward(dtype):
    filter = toy_denkf("perturbed").to(dtype)
    frames = toy_frames((2, 7), masks=2)  # a chunk, chunks that detach the belief, the last of which is not whole
    frames["measurement"], frames["action"] = frames["measurement"].to(dtype), frames["action"].to(dtype)
    filter.draw_noise(frames)
    eager = filter.sequence(frames.copy(), detach_every=2)
    eager_step = filter.step(eager[:, 2].copy())
    gradients = torch.autograd.grad(eager["belief", "mean"].square().sum(), list(filter.parameters()))
    filter.compile(chunk=2, backend="eager")
    compiled = filter.sequence(frames.copy(), detach_every=2)
    compiled_step = filter.step(eager[:, 2].copy())
    assert sorted(kind[0] for kind in filter.compiled._functions) == ["chunk", "chunk", "step"]
    assert_close(compiled, eager, filter.out_keys, dtype)
    assert_close(compiled_step, eager_step, filter.out_keys, dtype)
    ours = torch.autograd.grad(compiled["belief", "mean"].square().sum(), list(filter.parameters()))
    for value, expected in zip(ours, gradients, strict=True):
        torch.testing.assert_close(value, expected, rtol=10 * TOLERANCE[dtype], atol=10 * TOLERANCE[dtype])


@pytest.mark.skipif(not has_compiler(), reason="inductor needs a C++ compiler, g++")
@pytest.mark.parametrize("dtype", [torch.float32, pytest.param(torch.float64, marks=pytest.mark.slow)])
def test_inductor_gives_the_eager_sequence_and_gradients_for_a_seed(dtype):
    filter = linear_denkf("perturbed", noisy=True).with_modules(observation=LearnedObservation(nn.Linear(2, 2)))
    filter, frames, out = filter.to(dtype), TensorDict({"observation": torch.randn(2, 2, 2, dtype=dtype)}, [2, 2]), []
    for chunk in (0, 1):
        torch.manual_seed(1)
        sequence = filter.compile(chunk=chunk).sequence(frames.copy())
        loss = sequence["belief", "mean"].square().sum()
        out.append((sequence, torch.autograd.grad(loss, list(filter.parameters()))))
    (eager, gradients), (compiled, ours) = out
    assert_close(compiled, eager, filter.out_keys, dtype)
    assert any((gradient != 0).any() for gradient in gradients)
    for value, expected in zip(ours, gradients, strict=True):
        torch.testing.assert_close(value, expected, rtol=10 * TOLERANCE[dtype], atol=10 * TOLERANCE[dtype])


@pytest.mark.skipif(not has_compiler(), reason="a compiler is asked for, and dynamo alone is in its place")
def test_changes_after_compilation_take_effect(monkeypatch):
    """Leaves out some of what torch.compile checks before a call, and not that."""
    compile = torch.compile

    def traced(function, *, options, **others):
        checks = {"guard_filter_fn": options["guard_filter_fn"]}
        return compile(function, backend="eager", options=checks, **others)

    monkeypatch.setattr(torch, "compile", traced)
    filter = linear_denkf()
    filter = filter.with_modules(observation=LearnedObservation(StochasticMLP(2, 2, (4,), layer="none")))
    frames = TensorDict({"observation": torch.randn(2, 3, 2)}, [2, 3])
    compiled = pickle.loads(pickle.dumps(filter)).compile(chunk=1)
    means = []

    def agree(change):
        outs = []
        for model in (filter, compiled):
            change(model)
            sequence = model.sequence(frames.copy())
            parameters = [p for p in model.parameters() if p.requires_grad]
            outs.append((sequence, torch.autograd.grad(sequence["belief", "mean"].square().sum(), parameters)))
        (eager, gradients), (ours, others) = outs
        assert_close(ours, eager, filter.out_keys, torch.float32)
        for value, expected in zip(others, gradients, strict=True):
            torch.testing.assert_close(value, expected, rtol=2e-4, atol=2e-4)
        means.append(eager["belief", "mean"].detach())

    def freeze(model, frozen):
        next(model["observation"].parameters()).requires_grad_(not frozen)

    agree(lambda model: freeze(model, True))
    agree(lambda model: freeze(model, False))
    agree(lambda model: setattr(model["analysis"], "inflation", 1.5))
    agree(lambda model: setattr(model["observation"].module, "activation", nn.Tanh()))
    assert means[0].equal(means[1])
    for before, after in pairwise(means[1:]):
        assert not torch.allclose(before, after)
    frames = frames.double()
    agree(lambda model: model.double())
    assert means[-1].dtype == torch.double


def test_a_new_filter_of_other_modules_or_options_compiles_its_own(float64):
    frames = TensorDict({"observation": torch.randn(2, 3, 2)}, [2, 3])
    compiled = linear_kalman().compile(chunk=2, backend="eager")
    compiled.sequence(frames.copy())
    for change in (
        lambda one: one.with_modules(initial=MomentPrior(torch.zeros(2), torch.eye(2))),
        lambda one: one.with_options(update_at_reset=True),
    ):
        other = change(compiled)
        assert_close(
            other.sequence(frames.copy()),
            change(linear_kalman()).sequence(frames.copy()),
            other.out_keys,
            torch.float64,
        )
        assert {kind[0] for kind in other.compiled._functions} == {"chunk"}
        assert other.compiled is not compiled.compiled


def test_policy_data_resume_from_stored_beliefs(float64):
    """Slices that begin in the middle, an episode that begins inside of one, and a first belief that is all zero."""
    filter = linear_kalman()
    data = TensorDict({"observation": torch.randn(2, 3, 2), "is_init": torch.zeros(2, 3, 1, dtype=torch.bool)}, [2, 3])
    data["is_init"][0, 1] = True
    mean, cov = torch.randn(2, 3, 2), 0.5 * torch.eye(2).expand(2, 3, 2, 2)
    known = torch.ones(2, 3, 1, dtype=torch.bool)
    known[0, :2] = False
    mean[0, 0] = 0
    data["previous"] = TensorDict({"belief": {"mean": mean, "cov": cov.clone()}, "known": known}, [2, 3])
    eager = filter.sequence(data.copy())
    filter.compile(chunk=1, backend="eager")
    compiled = filter.sequence(data.copy())
    assert [kind[0] for kind in filter.compiled._functions] == ["chunk"]
    assert_close(compiled, eager, filter.out_keys, torch.float64)
    step = filter.compile(chunk=0).step(
        TensorDict({"observation": data["observation"][1, 0], "belief": {"mean": mean[1, 0], "cov": cov[1, 0]}})
    )
    assert_close(eager[1, 0], step, filter.belief_keys, torch.float64)


def test_a_stochastic_analysis_of_a_users_own_is_the_librarys(float64):
    frames, outs = TensorDict({"observation": torch.randn(3, 5, 2)}, [3, 5]), []
    for analysis in (EnsembleAnalysis("perturbed", observation_key="observation"), Perturbed()):
        filter = random_draws(linear_denkf("perturbed", noisy=True).with_modules(analysis=analysis))
        torch.manual_seed(1)
        outs.append(filter.sequence(frames.copy())["belief", "mean"])
    torch.testing.assert_close(*outs, rtol=0, atol=1e-12)


def test_compiled_step_draws_new_noise_outside():
    filter, means = linear_denkf("perturbed", noisy=True).compile(chunk=1, backend="eager"), []
    td = filter.initialise(TensorDict({"observation": torch.randn(2, 2)}, [2]))
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        means.append(filter.step(td.copy())["belief", "mean"])
    assert means[0].equal(means[1])
    assert not means[0].equal(means[2])
    assert len(filter.compiled._functions) == 1
