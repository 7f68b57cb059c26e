"""What a user meets at the border: stored beliefs, groups, no rows, outputs on request, guards, frame skips."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import FrameSkipTransform, TransformedEnv

from tests.filters.beliefs_for_tests import BELIEF, COV, ENSEMBLE, MEAN, VAR, close
from tests.filters.factories import (
    FixedEnsemble,
    linear_denkf,
    linear_kalman,
    toy_denkf,
    toy_frames,
)
from tests.transforms.envs_for_tests import base_env
from torch_denkf.modules import (
    EnsembleAnalysis,
)
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


class MeanIfThere(FixedEnsemble):
    """An initial belief around a mean, if there is one."""

    def __init__(self, members):
        super().__init__(members)
        self.optional_keys = [MEAN]

    def compute(self, mean=None, *, batch_size):
        ensemble, *others = super().compute(batch_size=batch_size)
        return ensemble if mean is None else ensemble + mean.unsqueeze(-2), *others


@pytest.mark.parametrize("run", ["initialise", "sequence"])
def test_a_start_knows_nothing_of_the_belief_that_is_there(run):
    filter = linear_denkf()
    filter = filter.with_modules(initial=MeanIfThere(filter.initial.members))
    frames = TensorDict({"observation": torch.randn(3, 5, 2)}, [3, 5]).set(MEAN, torch.ones(3, 5, 2))
    out = filter.sequence(frames)[:, 0] if run == "sequence" else filter.initialise(frames[:, 0])
    assert (out[ENSEMBLE] == filter.initial.members).all()


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


def test_behind_a_frame_skip_the_belief_takes_one_step_a_skip():
    env = base_env(seed=0, batch_size=[2])
    filter = linear_denkf()
    skipping = TransformedEnv(TransformedEnv(env, DEnKFTransform(filter)), FrameSkipTransform(3))
    rollout = skipping.rollout(2)
    row = filter.step(
        rollout[:, 0].select("belief", "action").copy().set("observation", rollout["next", "observation"][:, 0])
    )
    close(rollout["next"][:, 0], row, [MEAN], atol=1e-6)
    inside = TransformedEnv(
        TransformedEnv(base_env(seed=0, batch_size=[2]), FrameSkipTransform(3)), DEnKFTransform(filter)
    )
    close(inside.rollout(2), rollout, [MEAN], atol=1e-6)
