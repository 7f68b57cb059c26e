"""The warning that a filter of a policy starts from a belief which has seen the frame already."""

import warnings

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import set_recurrent_mode

from tests.filters.factories import linear_kalman, linear_system
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.transforms import DEnKFTransform

MEAN = ("belief", "mean")


def said(record):
    return [str(one.message) for one in record if "Said once" in str(one.message)]


def linear_env(*transforms):
    F, Q, H, R = linear_system()
    env = TransformedEnv(LinearGaussianEnv(F, H, Q.diag().sqrt(), R.sqrt(), batch_size=[2]))
    for transform in transforms:
        env.append_transform(transform)
    return env


def test_a_filter_in_environment_and_policy_counts_readings_twice_and_says_so():
    filter = linear_kalman()
    env = linear_env(DEnKFTransform(filter))
    actor = TensorDictModule(lambda mean: mean[..., :1], [MEAN], ["action"])
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        env.rollout(6, TensorDictSequential(filter, actor))
    assert len(said(record)) == 1
    assert "counts twice" in said(record)[0]
    assert "make_tensordict_primer" in said(record)[0]


@pytest.mark.parametrize("case", ["environment", "policy", "loop", "data"])
def test_no_false_alarm_for_a_filter_in_one_place(case):
    filter = linear_kalman()
    actor = TensorDictModule(lambda mean: mean[..., :1], [MEAN], ["action"])
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*counts twice.*")
        if case == "environment":
            linear_env(DEnKFTransform(filter)).rollout(4, actor)
        elif case == "policy":
            linear_env(InitTracker(), filter.make_tensordict_primer()).rollout(4, TensorDictSequential(filter, actor))
        else:
            data = linear_env(DEnKFTransform(filter)).rollout(4, actor)
            if case == "data":
                with set_recurrent_mode(True):
                    filter(data)
            else:  # what the transform left, and the next frame
                filter.step(data[:, -1]["next"].exclude("reward").set("observation", torch.zeros(2, 2)))
