"""Tests borders that a user meets: stored beliefs, groups, no rows, outputs on request, guards, frame skips."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from tests.filters.beliefs_for_tests import BELIEF, COV, ENSEMBLE, MEAN, VAR, close
from tests.filters.factories import linear_denkf, linear_kalman, toy_denkf, toy_frames
from tests.transforms.envs_for_tests import base_env
from torch_denkf.modules import EnsembleAnalysis
from torch_denkf.transforms import DEnKFTransform

# --------------------------------------------------------------------------------------------------- stored beliefs


@pytest.mark.parametrize("make", [linear_denkf, linear_kalman])
@pytest.mark.parametrize("marked", [False, True])
def test_a_stored_carry_alone_starts_the_sequence(float64, make, marked):
    filter = make()
    whole = filter.sequence(TensorDict({"observation": torch.randn(2, 80, 2)}, [2, 80]))
    tail = whole[:, 50:].select("observation", *filter.carry_keys).copy()
    if marked:  # as SliceSampler marks the beginning of a slice
        tail["is_init"] = torch.zeros(2, 30, 1, dtype=torch.bool)
        tail["is_init"][:, 0] = True
    close(filter.sequence(tail), whole[:, 50:], filter.belief_keys)


def test_stored_beliefs_start_anew_where_marks_say_so_and_nowhere_else(float64):
    filter = linear_denkf()
    frames = TensorDict({"observation": torch.randn(2, 9, 2)}, [2, 9])
    frames["is_init"] = torch.zeros(2, 9, 1, dtype=torch.bool)
    frames["is_init"][1, 5] = True
    stored = frames.copy().set(ENSEMBLE, 100 + torch.randn(2, 9, 6, 2))
    out = filter.sequence(stored.copy())
    assert out[ENSEMBLE][1, 5].equal(stored[ENSEMBLE][1, 5])
    assert not out[ENSEMBLE][0, 5].equal(stored[ENSEMBLE][0, 5])


# ----------------------------------------------------------------------------------------------------------- groups


@pytest.mark.parametrize("mark", ["is_init", "done"])
def test_marks_in_a_group_of_agents_reset_the_belief(float64, mark):
    filter = linear_denkf()
    frames = TensorDict({"observation": torch.randn(2, 9, 2)}, [2, 9])
    start = torch.zeros(2, 9, 1, dtype=torch.bool)
    start[:, 0] = start[1, 4] = True
    expected = filter.sequence(frames.copy().set("is_init", start))
    agents = torch.zeros(2, 9, 3, 1, dtype=torch.bool)
    if mark == "is_init":
        agents[..., 1, :] = start
        grouped = frames.copy().set(("agents", "is_init"), agents)
    else:
        agents[1, 3, 2] = True
        grouped = frames.copy().set(("next", "agents", "done"), agents)
    close(filter.sequence(grouped), expected, BELIEF)


# ------------------------------------------------------------------------------------------------ no rows, no steps


# ------------------------------------------------------------------------------------------------- what is returned


def test_keep_returns_what_is_asked_for(float64):
    filter, frames = toy_denkf(), toy_frames((2, 3))
    filter.draw_noise(frames)
    expected = filter.sequence(frames.copy())
    for chunk in (0, 2):
        filter.compile(chunk=chunk, backend="eager")
        for keep in ([MEAN, ("sensor", "ensemble"), ("info", "nis")], [VAR, MEAN]):
            out = filter.sequence(frames.copy(), keep=keep)
            assert set(out.exclude(*frames.keys()).keys(True, True)) == set(keep)
            close(out, expected, keep)
    with pytest.raises(ValueError, match=r"keep names \['nothing'\]"):
        filter.sequence(frames, keep=["nothing"])


def test_the_covariance_of_an_ensemble_on_request(float64):
    filter = linear_denkf()
    filter = filter.with_modules(analysis=EnsembleAnalysis("etkf", observation_key="observation", covariance=True))
    frames = TensorDict({"observation": torch.randn(3, 5, 2)}, [3, 5])
    out = filter.sequence(frames)
    deviations = out[ENSEMBLE] - out[MEAN].unsqueeze(-2)
    close({COV: out[COV]}, {COV: deviations.mT @ deviations / 5}, [COV])
    assert COV in filter.belief_keys
    env = TransformedEnv(base_env(seed=0, batch_size=[2]), DEnKFTransform(filter))
    assert env.reset()[COV].shape == (2, 2, 2)


# ------------------------------------------------------------------------------------------------- compiled, guards


# ------------------------------------------------------------------------------------------------------ frame skips
