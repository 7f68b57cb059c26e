"""A filter as a composition: its parts, copies, precisions, compiled steps, inside a policy."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.factories import (
    OBS,
    FixedEnsemble,
    NoisyLinear,
    assert_equal,
    linear_denkf,
    linear_kalman,
    linear_system,
    stepwise,
    toy_denkf,
    toy_frames,
)
from tests.filters.gaussian_for_tests import CONTROL, linear_filter
from tests.filters.gaussian_for_tests import FILTERS as GAUSSIAN_FILTERS
from tests.filters.particle_for_tests import bootstrap
from torch_denkf.baselines import LSTMFilter
from torch_denkf.envs.linear import LinearGaussianEnv
from torch_denkf.filters import Filter
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis
from torch_denkf.modules.observation import LinearObservation
from torch_denkf.transforms import DEnKFTransform

BELIEF = [("belief", "ensemble"), ("belief", "mean"), ("belief", "var")]

# ------------------------------------------------------------------------------------- parts of a composition


def test_modules_are_sorted_by_their_keys_whatever_their_order(float64):
    filter = toy_denkf()
    frames = filter.draw_noise(toy_frames((2, 5)))
    # The sensor behind the transition: still a frame module.
    order = ("transition", "sensor", "observation", "noise", "analysis")
    other = Filter({name: filter[name] for name in order}, initial=filter.initial)
    assert [part for _, part in other.structure.frames] == [filter["sensor"], filter["noise"]]
    assert_equal(other.sequence(frames.copy()), filter.sequence(frames.copy()), filter.out_keys)


def test_nested_sequences_are_the_flat_filter(float64):
    flat = toy_denkf("perturbed")
    front = TensorDictSequential(flat["sensor"], flat["noise"])
    back = TensorDictSequential(flat["observation"], TensorDictSequential(flat["analysis"]))
    nested = Filter(front, flat["transition"], back, initial=flat.initial)
    frames = toy_frames((3, 9), masks=OBS)
    nested.draw_noise(frames)
    assert set(frames["noise"].keys()) == {"0.0", "1", "2.1.0", "initial"}
    of_flat = frames.exclude("noise")
    for place, name in (("0.0", "sensor"), ("1", "transition"), ("2.1.0", "analysis"), ("initial", "initial")):
        of_flat["noise", name] = frames["noise", place]  # noise is named by the place
    assert_equal(nested.sequence(frames.copy()), flat.sequence(of_flat.copy()), flat.out_keys)
    with pytest.raises(KeyError, match=r"'noise', 'sensor'.* is noise of no module"):
        nested.sequence(of_flat)
    assert_equal(stepwise(nested, frames), nested.sequence(frames.copy()), BELIEF, atol=1e-12)


def test_a_filter_with_other_keys(float64):
    # A second filter on the same tensordict, in its own name space.
    plain = linear_denkf()
    F, _, H, R = linear_system()

    motion, start = NoisyLinear(F), FixedEnsemble(plain.initial.members)
    motion.in_keys, motion.out_keys = [("two", "ensemble")], [("two_forecast", "ensemble")]
    start.out_keys = [("two", name) for name in ("ensemble", "mean", "var")]
    names = {
        "predicted_key": ("two_forecast", "y"),
        "noise_variance_key": "r",
        "belief_prefix": "two",
        "info_prefix": "i",
    }
    other = Filter(
        motion,
        LinearObservation(H, in_key=("two_forecast", "ensemble"), out_key=("two_forecast", "y")),
        ConstantNoise(R.sqrt(), in_key="y", out_key="r"),
        EnsembleAnalysis(
            "etkf", forecast_key=("two_forecast", "ensemble"), observation_key="y", observed_key="seen", **names
        ),
        initial=start,
        init_key="first",
    )
    y, seen, first = torch.randn(2, 7, 2), torch.rand(2, 7, 1) < 0.7, torch.rand(2, 7, 1) < 0.3
    expected = plain.sequence(TensorDict({"observation": y, "observed": seen, "is_init": first}, [2, 7]))
    out = other.sequence(TensorDict({"y": y, "seen": seen, "first": first}, [2, 7]))
    assert out["two"].keys() == expected["belief"].keys()
    assert all(out["two", name].equal(expected["belief", name]) for name in ("ensemble", "mean", "var"))


def test_a_state_dict_is_all_that_is_learned(float64):
    filter, fresh = toy_denkf(), toy_denkf()
    frames = filter.draw_noise(toy_frames((2, 5)))
    expected = filter.sequence(frames.copy())
    assert not fresh.sequence(frames.copy())["belief", "mean"].equal(expected["belief", "mean"])
    fresh.load_state_dict(filter.state_dict())
    assert_equal(fresh.sequence(frames.copy()), expected, filter.out_keys)


def test_keep_selects_the_outputs(float64):
    filter, frames = toy_denkf(), toy_frames((2, 3))
    filter.draw_noise(frames)
    expected = filter.sequence(frames.copy())
    some, moments = [BELIEF[1], ("sensor", "ensemble"), ("info", "nis")], [BELIEF[2], BELIEF[1]]
    for chunk, keep in ((0, some), (0, moments), (1, moments)):
        out = filter.compile(chunk=chunk, backend="eager").sequence(frames.copy(), keep=keep)
        assert set(out.exclude(*frames.keys()).keys(True, True)) == set(keep)
        assert_equal(out, expected, keep, atol=1e-12)
    with pytest.raises(ValueError, match=r"keep names \['nothing'\]"):
        filter.sequence(frames, keep=["nothing"])


# ----------------------------------------------------------------------------------------------- in a policy


class Actor(TensorDictModule):
    def __init__(self):
        super().__init__(torch.nn.Linear(2, 1), in_keys=[("belief", "mean")], out_keys=["action"])


def lstm(**kwargs):
    sizes = {"state_dim": 2, "hidden_size": 6, "observation_dim": 2, "scale": [20.0, 20.0]}
    return LSTMFilter(None, observation_key="observation", **sizes, **kwargs)


def particles(**kwargs):
    """Without any randomness: one start, no motion noise, transport."""
    return bootstrap(6, noisy=False, initial=FixedEnsemble(torch.randn(6, 2)), resampling="transport", **kwargs)


GAUSSIAN = [partial(linear_filter, name, control=True) for name in GAUSSIAN_FILTERS]


@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize("make", [linear_denkf, linear_kalman, *GAUSSIAN, particles, lstm])
def test_policy_transform_and_sequence_agree(float64, update_at_reset, make):
    F, Q, H, R = linear_system()
    filter, actor = make(update_at_reset=update_at_reset), Actor()

    def env(*transforms):
        system = (F, H, Q.diagonal().sqrt(), R.sqrt())
        base = LinearGaussianEnv(
            *system, control=torch.tensor(CONTROL), missing=0.3, batch_size=[3], max_steps=[4, 5, 30], seed=1
        )
        env = TransformedEnv(base)
        for transform in transforms:
            env.append_transform(transform)
        return env

    def rollout(env, policy):
        return env.rollout(12, policy, break_when_any_done=False)

    policy = TensorDictSequential(filter, actor)
    with torch.no_grad():
        by_policy = rollout(env(get_env_transforms_from_module(policy)), policy)
        by_transform = rollout(env(InitTracker(), DEnKFTransform(filter)), actor)
    assert by_policy["is_init"].sum(1).flatten().tolist() == [3, 3, 1]
    assert by_policy["state"].equal(by_transform["state"]), "the same episodes"
    # At the root stands the belief that has seen the observation there, for the actor, and the one before it.
    belief = filter.belief_keys
    assert_equal(by_policy, by_transform, belief, atol=1e-13)
    assert_equal(by_policy["next", "previous"], by_policy, filter.carry_keys)
    assert by_policy["previous", "known"].equal(~by_policy["is_init"])
    frames = by_policy.select("observation", "observed", "is_init", "action")
    by_sequence = filter.sequence(frames.copy())
    assert_equal(by_sequence, by_policy, belief, atol=1e-13)
    assert (by_sequence["belief", "mean"][:, 2] - by_sequence["belief", "mean"][:, 0]).norm(dim=-1).min() > 0.1
    # A slice starts from what is stored.
    assert_equal(filter.sequence(by_policy[:, 2:9].copy()), by_policy[:, 2:9], belief, atol=1e-13)
