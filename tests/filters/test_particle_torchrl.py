"""What carries particles: a policy's primer, an environment without the particles, and summaries of what is carried."""

import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv, check_env_specs

from tests.filters.factories import S, assert_equal, toy_frames
from tests.filters.particle_for_tests import E, bootstrap, toy_filter
from tests.transforms.envs_for_tests import base_env
from torch_denkf.functional.weighted import weighted_mean, weighted_var
from torch_denkf.transforms import DEnKFTransform


def test_primer_holds_particles_and_weights():
    filter = toy_filter()
    primer = filter.make_tensordict_primer()
    assert primer.primers["previous", "belief", "ensemble"].shape == (E, S)
    assert primer.primers["previous", "belief", "log_weight"].shape == (E,)


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


def test_an_environment_need_not_store_particles():
    env = TransformedEnv(base_env(batch_size=[3], max_steps=[4, 5, 30]))
    env.append_transform(DEnKFTransform(bootstrap(8), store_ensemble=False))
    check_env_specs(env)
    rollout = env.rollout(12, break_when_any_done=False)
    assert ("belief", "log_weight") not in rollout.keys(True, True)
    assert ("belief", "mean") in rollout.keys(True, True)
