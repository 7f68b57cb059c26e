"""Oracles: the policy against the transform and the sequence; specs, copies and the compiled step."""

import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv, check_env_specs
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.factories import FixedEnsemble, S, assert_equal, linear_system, toy_frames
from tests.filters.particle_for_tests import BELIEF, E, bootstrap, toy_filter
from torch_denkf.envs.linear import LinearGaussianEnv
from torch_denkf.functional.weighted import weighted_mean, weighted_var
from torch_denkf.transforms import DEnKFTransform


class Actor(TensorDictModule):
    def __init__(self):
        super().__init__(torch.nn.Linear(2, 1), in_keys=[("belief", "mean")], out_keys=["action"])


def make_env(**kwargs):
    F, Q, H, R = linear_system()
    return LinearGaussianEnv(F, H, Q.diagonal().sqrt(), R.sqrt(), missing=0.3, seed=1, **kwargs)


@pytest.mark.parametrize("update_at_reset", [False, True])
def test_policy_transform_and_sequence_agree(float64, update_at_reset):
    # Without any randomness: one start, no motion noise, transport.
    start = FixedEnsemble(torch.randn(E, 2))
    filter = bootstrap(E, noisy=False, initial=start, resampling="transport", update_at_reset=update_at_reset)
    actor = Actor()

    def env(*transforms):
        env = TransformedEnv(make_env(batch_size=[3], max_steps=[4, 5, 30]))
        for transform in transforms:
            env.append_transform(transform)
        return env

    policy = TensorDictSequential(filter, actor)
    with torch.no_grad():
        by_policy = env(get_env_transforms_from_module(policy)).rollout(12, policy, break_when_any_done=False)
        by_transform = env(InitTracker(), DEnKFTransform(filter)).rollout(12, actor, break_when_any_done=False)
    assert by_policy["is_init"].sum(1).flatten().tolist() == [3, 3, 1]
    assert by_policy["state"].equal(by_transform["state"]), "the same episodes"
    assert_equal(by_policy, by_transform, BELIEF, atol=1e-12)
    frames = by_transform.select("observation", "observed", "is_init", "action")
    assert_equal(filter.sequence(frames), by_transform, BELIEF, atol=1e-12)
    assert (by_transform["belief", "log_weight"].std(-1) > 0).any()


def test_primer_holds_particles_and_weights():
    filter = toy_filter()
    primer = filter.make_tensordict_primer()
    assert primer.primers["previous", "belief", "ensemble"].shape == (E, S)
    assert primer.primers["previous", "belief", "log_weight"].shape == (E,)


@pytest.mark.parametrize("store_ensemble", [True, False])
@pytest.mark.parametrize("batch_size", [[], [3]])
def test_specs_and_partial_resets_in_an_environment(store_ensemble, batch_size):
    steps = 4 if not batch_size else [4, 5, 30]
    base = make_env(batch_size=batch_size, max_steps=steps)
    env = TransformedEnv(base, DEnKFTransform(bootstrap(8), store_ensemble=store_ensemble))
    check_env_specs(env)
    rollout = env.rollout(12, break_when_any_done=False)
    assert (("belief", "log_weight") in rollout.keys(True, True)) == store_ensemble
    if store_ensemble:
        rollout = rollout if batch_size else rollout.unsqueeze(0)
        start = torch.cat([torch.ones_like(rollout["done"][:, :1]), rollout["next", "done"][:, :-1]], 1).squeeze(-1)
        weights = rollout["belief", "log_weight"]
        equal = torch.full((8,), -math.log(8))
        torch.testing.assert_close(weights[start], equal.expand_as(weights[start]))
        kept = ~start[:, 1:]
        for key in ("log_weight", "ensemble", "mean"):
            assert rollout["belief", key][:, 1:][kept].equal(rollout["next", "belief", key][:, :-1][kept])
        mean = weighted_mean(rollout["next", "belief", "ensemble"], rollout["next", "belief", "log_weight"])
        torch.testing.assert_close(rollout["next", "belief", "mean"], mean)


def test_summaries_are_weighted(float64):
    filter = toy_filter()
    particles, log_weights = torch.randn(4, E, S), torch.randn(4, E).log_softmax(-1)
    out = filter.summarise(TensorDict({"belief": {"ensemble": particles, "log_weight": log_weights}}, [4]))
    assert out["belief", "mean"].equal(weighted_mean(particles, log_weights))
    assert out["belief", "var"].equal(weighted_var(particles, log_weights))
    assert (out["belief", "mean"] - particles.mean(-2)).abs().max() > 0.1
    # What a step writes is what follows from its carry.
    step = filter.sequence(toy_frames((3, 5)))
    again = filter.summarise(step.select(*filter.carry_keys))
    assert_equal(again, step, [("belief", "mean"), ("belief", "var")], atol=1e-14)


def test_copies(float64):
    filter = toy_filter()
    frames = filter.draw_noise(toy_frames((2, 5)))
    expected = filter.sequence(frames.copy())
    assert_equal(pickle.loads(pickle.dumps(filter)).sequence(frames.copy()), expected, BELIEF)
    fresh = toy_filter()
    fresh.load_state_dict(filter.state_dict())
    assert_equal(fresh.sequence(frames.copy()), expected, BELIEF)


def test_compiled_step_equals_eager(float64):
    # "aot_eager" traces forward and backward into one graph each, which is what breaks if anything does. The other
    # schemes are compiled with the mathematics, tests/functional/test_resampling.py.
    filter = toy_filter("soft")
    td = filter.initialise(toy_frames((3,), resets=False))
    td["belief", "log_weight"] = torch.randn(3, E).log_softmax(-1)
    filter.draw_noise(td)
    results = []
    torch._dynamo.reset()
    for step in (filter.step, torch.compile(filter.step, fullgraph=True, backend="aot_eager")):
        filter.zero_grad()
        out = step(td.copy())
        out["belief", "mean"].square().sum().backward()
        results.append((out.detach(), [p.grad.clone() for p in filter.parameters() if p.grad is not None]))
    (eager, grads), (compiled, compiled_grads) = results
    assert_equal(compiled, eager, filter.out_keys, atol=1e-12)
    assert len(grads) > 10
    torch.testing.assert_close(compiled_grads, grads)
