"""The transform on frames that are missing, broken or not there at all, and what raises."""

import pytest
import torch
from torchrl.envs import Compose, DoubleToFloat, TransformedEnv

from tests.filters.factories import assert_equal, linear_denkf
from tests.functional.checks import assert_raises
from tests.transforms.envs_for_tests import BELIEF, Changed, base_env, random_filter, toy_base_env, toy_filter
from torch_denkf.imperfect import RejectReadings
from torch_denkf.transforms import DEnKFTransform


def break_observation(honest):
    """NaN in the reading from the third step on; ``observed`` says so, or lies."""

    def change(td):
        bad = td["step"] >= 3
        td["observed"] = ~bad if honest else torch.ones_like(bad)
        return td.set("observation", torch.where(bad, torch.nan, td["observation"]))

    return Changed(change)


def zero_unobserved(td):
    return td.set("observation", torch.where(td["observed"], td["observation"], 0.0))


@pytest.mark.parametrize(("make_base", "make_filter"), [(base_env, random_filter), (toy_base_env, toy_filter)])
def test_unobserved_nan_changes_nothing(make_base, make_filter):
    filter, rollouts = make_filter(), []
    for transforms in ([break_observation(True)], [break_observation(True), Changed(zero_unobserved)]):
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

    def make(*transforms, honest=False):
        torch.manual_seed(1)
        return TransformedEnv(
            make_base(batch_size=[3]), Compose(break_observation(honest), *transforms, DEnKFTransform(filter))
        )

    assert make().rollout(2).shape == (3, 2)
    assert_raises(ValueError, r"NaN or infinity in \['observation'\].*RejectReadings", make().rollout, 8)
    # Where such a reading is rejected the beliefs are those under a mask that tells the truth.
    reject = RejectReadings({"observation": "observed"})
    assert_equal(make(reject).rollout(8)["next"], make(honest=True).rollout(8)["next"], BELIEF)


def test_divergence_message_names_the_cause():
    filter = linear_denkf()
    filter["transition"].matrix.mul_(1e30)
    env = TransformedEnv(base_env(), DEnKFTransform(filter))
    assert_raises(ValueError, "all inputs are finite, and the filter diverged", env.rollout, 5)


# ------------------------------------------------------------------------------------------------------ errors


def test_float64_environment_and_float32_filter():
    torch.set_default_dtype(torch.float64)
    try:
        base = base_env()
    finally:
        torch.set_default_dtype(torch.float32)
    with pytest.raises(TypeError, match="DoubleToFloat"):
        _ = TransformedEnv(base, DEnKFTransform(linear_denkf())).observation_spec
    mended = TransformedEnv(
        base, Compose(DoubleToFloat(in_keys=["observation"], in_keys_inv=["action"]), DEnKFTransform(linear_denkf()))
    )
    assert mended.rollout(3)["next", "belief", "mean"].dtype == torch.float32
