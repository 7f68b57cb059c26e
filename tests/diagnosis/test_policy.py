"""The warning that a filter of a policy starts from a belief which has seen the frame already."""

import warnings

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.envs import InitTracker
from torchrl.modules import set_recurrent_mode

from tests.diagnosis.test_masks import said
from tests.diagnosis.test_observers import actor, environment
from tests.filters.factories import linear_kalman
from torch_denkf.transforms import DEnKFTransform


def test_filter_in_environment_and_policy_warns_of_double_use():
    filter = linear_kalman()
    env = environment(DEnKFTransform(filter))
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        env.rollout(6, TensorDictSequential(filter, actor()))
    assert len(said(record)) == 1
    assert "counts twice" in said(record)[0]
    assert "make_tensordict_primer" in said(record)[0]


@pytest.mark.parametrize("case", ["environment", "policy", "loop", "data"])
def test_no_false_alarm_for_a_filter_in_one_place(case):
    filter = linear_kalman()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*counts twice.*")
        if case == "environment":
            environment(DEnKFTransform(filter)).rollout(4, actor())
        elif case == "policy":
            environment(InitTracker(), filter.make_tensordict_primer()).rollout(
                4, TensorDictSequential(filter, actor())
            )
        else:
            data = environment(DEnKFTransform(filter)).rollout(4, actor())
            if case == "data":
                with set_recurrent_mode(True):
                    filter(data)
            else:  # what the transform left, and the next frame
                filter.step(data[:, -1]["next"].exclude("reward").set("observation", torch.zeros(2, 2)))
