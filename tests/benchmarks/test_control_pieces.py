"""Which pieces of episodes a cartpole's filter learns from."""

import pytest
import torch
from torchrl.envs import ExplorationType

from benchmarks.control import cartpole
from benchmarks.control.learning import Learner
from benchmarks.control.run import rollout
from benchmarks.control.tasks import TASKS


@pytest.fixture
def learner():
    task = TASKS["cartpole"]
    return Learner(cartpole.unlearned_filter(4), task.prior, 8, task.learning)


@pytest.fixture
def data():
    """Two episodes of 250 steps in the middle of the track, in which all angles are read as zero."""
    data = rollout(cartpole.NoisyCartpole(2, 0.0), None, cartpole.STEPS, ExplorationType.RANDOM)
    data["observation"].zero_()
    return data


def test_pieces_run_forward_in_time(learner, data):
    """Each of 25 neighbouring steps, from the first to the last; all steps of both episodes are in one."""
    number = torch.arange(500.0).view(2, 250, 1)
    data["observation"][..., 2:], data["action"] = number, number / 500
    data["state"] = number.expand(-1, -1, 5).clone()
    learner.add(data)
    pieces = learner.episodes[:]
    steps = pieces["observation"][..., 2]
    assert steps.shape == (20, 25)
    assert steps.diff(dim=1).eq(1).all()
    assert sorted(steps[:, 0].int().tolist()) == list(range(0, 500, 25))
    assert pieces["state"].equal(steps.unsqueeze(-1).expand(-1, -1, 5))
    assert pieces["action"].equal(steps.unsqueeze(-1) / 500)


@pytest.mark.parametrize(("position", "kept"), [(1.4, 20), (-1.4, 20), (1.6, 19), (-1.6, 19)])
def test_a_piece_is_left_out_where_the_cart_was_read_beyond_one_and_a_half_metres(position, kept, learner, data):
    data["observation"][1, 130, 0] = position
    learner.add(data)
    assert len(learner.episodes) == kept


def test_a_batch_of_which_nothing_is_kept_is_no_error(learner, data):
    data["observation"][..., 0] = 1.6
    data["observation"][1, :, 1] = 1.9  # angles are noisy, and are kept
    learner.add(data)
    learner.update(1)
    assert len(learner.episodes) == 0
