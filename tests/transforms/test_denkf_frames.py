"""The transform on frames that are missing, broken or not there at all, and what it refuses."""

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    Transform,
    TransformedEnv,
)

from tests.filters.factories import assert_equal, linear_denkf, linear_kalman
from tests.functional.checks import assert_refused
from tests.transforms.envs_for_tests import (
    BELIEF,
    base_env,
    filtered_env,
    fixed_filter,
    random_filter,
    toy_base_env,
    toy_filter,
)
from torch_denkf.transforms import DEnKFTransform


class BreakObservation(Transform):
    """NaN in the reading from the third step on; ``observed`` says so, or lies."""

    def __init__(self, honest):
        super().__init__()
        self.honest = honest

    def _call(self, next_tensordict):
        bad = next_tensordict["step"] >= 3
        next_tensordict["observation"] = torch.where(bad, torch.nan, next_tensordict["observation"])
        next_tensordict["observed"] = ~bad if self.honest else torch.ones_like(bad)
        return next_tensordict

    _reset = lambda self, tensordict, tensordict_reset: self._call(tensordict_reset)  # noqa: E731


class ZeroUnobserved(Transform):
    def _call(self, next_tensordict):
        reading = next_tensordict["observation"]
        next_tensordict["observation"] = torch.where(next_tensordict["observed"], reading, 0.0)
        return next_tensordict

    _reset = lambda self, tensordict, tensordict_reset: self._call(tensordict_reset)  # noqa: E731


@pytest.mark.parametrize(("make_base", "make_filter"), [(base_env, random_filter), (toy_base_env, toy_filter)])
def test_unobserved_nan_changes_nothing(make_base, make_filter):
    filter, rollouts = make_filter(), []
    for transforms in ([BreakObservation(True)], [BreakObservation(True), ZeroUnobserved()]):
        env = TransformedEnv(make_base(batch_size=[3]), Compose(*transforms, DEnKFTransform(filter)))
        torch.manual_seed(1)
        rollouts.append(env.rollout(8))
    assert rollouts[0]["observation"].isnan().any()
    assert not rollouts[1]["observation"].isnan().any()
    assert rollouts[0]["belief", "mean"].isfinite().all()
    assert_equal(rollouts[0]["next"], rollouts[1]["next"], BELIEF)


@pytest.mark.parametrize(("make_base", "make_filter"), [(base_env, random_filter), (toy_base_env, toy_filter)])
def test_observed_nan_raises_and_names_the_key(make_base, make_filter):
    filter = make_filter()

    def make(honest=False, **kwargs):
        transforms = Compose(BreakObservation(honest), DEnKFTransform(filter, **kwargs))
        torch.manual_seed(1)
        return TransformedEnv(make_base(batch_size=[3]), transforms)

    assert make().rollout(2).shape == (3, 2)
    assert_refused(ValueError, r"NaN or infinity in \['observation'\].*'observed'", make().rollout, 8)
    # Without the check such a reading counts as missing: the beliefs are those under a mask that tells the truth.
    assert_equal(make(check_finite=False).rollout(8)["next"], make(honest=True).rollout(8)["next"], BELIEF)


def test_nan_at_reset_with_an_update_there():
    env = TransformedEnv(base_env(), Compose(NanAtReset(), DEnKFTransform(fixed_filter(update_at_reset=True))))
    assert_refused(ValueError, r"NaN or infinity in \['observation'\]", env.reset)


class NanAtReset(Transform):
    def _call(self, next_tensordict):
        return next_tensordict

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset.set("observation", torch.full_like(tensordict_reset["observation"], torch.nan))


def test_divergence_is_told_apart():
    filter = linear_denkf()
    filter["transition"].matrix.mul_(1e30)
    assert_refused(ValueError, "the filter diverged", TransformedEnv(base_env(), DEnKFTransform(filter)).rollout, 5)


# ------------------------------------------------------------------------------------------------------ errors


def test_missing_key_names_key_and_environment():
    filter = linear_kalman(observation_key="gps")
    assert_refused(KeyError, r"'gps'.*LinearGaussianEnv", TransformedEnv(base_env(), DEnKFTransform(filter)).reset)
    with pytest.raises(KeyError, match=r"'gps'.*LinearGaussianEnv"):
        _ = TransformedEnv(base_env(), DEnKFTransform(filter)).observation_spec


def test_lost_belief_is_an_error():
    env = filtered_env()
    td = env.rand_action(env.reset()).exclude("belief")
    assert_refused(KeyError, r"carries the belief in \('belief', 'ensemble'\)", env.step, td)


def test_float64_environment_and_float32_filter():
    torch.set_default_dtype(torch.float64)
    try:
        base = base_env()
    finally:
        torch.set_default_dtype(torch.float32)
    with pytest.raises(TypeError, match="DoubleToFloat"):
        _ = TransformedEnv(base, DEnKFTransform(linear_denkf())).observation_spec
    mended = TransformedEnv(
        base,
        Compose(DoubleToFloat(in_keys=["observation"], in_keys_inv=["action"]), DEnKFTransform(linear_denkf())),
    )
    assert mended.rollout(3)["next", "belief", "mean"].dtype == torch.float32


def test_constructor_errors():
    assert_refused(TypeError, "together with its initial belief", DEnKFTransform, TensorDictSequential(*fixed_filter()))
    assert_refused(TypeError, "Linear", DEnKFTransform, nn.Linear(1, 1))
    with pytest.raises(TypeError, match="has its initial belief already"):
        DEnKFTransform(fixed_filter(), initial=fixed_filter().initial)
    assert_refused(KeyError, "'info', 'gain'", DEnKFTransform, fixed_filter(), diagnostics=[("info", "gain")])
