"""Oracle: held readings written down by hand, and a loop over what was emitted."""

import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from tests.transforms.envs_for_tests import base_env
from torch_denkf.envs import HoldReading

NAN = float("nan")


def held_env(**kwargs):
    return TransformedEnv(base_env(missing=0.5, **kwargs), HoldReading())


def by_hand(data):
    """Returns what is held in data ``[B, T]``, row by row and step by step; an episode begins where its step is 0."""
    held = torch.zeros_like(data["observation"])
    for row in range(data.shape[0]):
        last = torch.zeros_like(held[0, 0])
        for step in range(data.shape[1]):
            if data["step"][row, step] == 0:
                last = torch.zeros_like(last)
            if data["observed"][row, step]:
                last = data["observation"][row, step]
            held[row, step] = last
    return held


def test_episodes_that_end_apart():
    """Rows of 3, 5 and 4 steps: each is reset, and the others keep what they hold."""
    env = held_env(batch_size=[3], max_steps=[3, 5, 4])
    data = env.rollout(60, break_when_any_done=False)
    assert (data["step"] == 0).sum((1, 2)).tolist() == [20, 12, 15]
    assert data["held"].equal(by_hand(data))
    assert not data["held"].isnan().any()
    began = data["step"].squeeze(-1).eq(0) & ~data["observed"].squeeze(-1)
    assert began.any()
    assert data["held"][began].eq(0).all()


def test_reset_clears_the_held_reading():
    for reading, seen, held in ((NAN, False, 0.0), (5.0, True, 5.0)):
        frame = TensorDict({"observation": torch.tensor([reading]), "observed": torch.tensor([seen])})
        assert HoldReading()._reset(TensorDict({"held": torch.tensor([2.0])}), frame)["held"].item() == held


def test_environments_that_reset_by_themselves():
    """One tensordict comes for both; the rows that reset take the new episode's reading, or zero."""
    both = TensorDict(
        {
            "observation": torch.tensor([[1.0], [2.0], [NAN]]),
            "observed": torch.tensor([[True], [True], [False]]),
            "held": torch.tensor([[7.0], [8.0], [9.0]]),
            "_reset": torch.tensor([[False], [True], [True]]),
        },
        [3],
    )
    assert HoldReading()._reset_on_native_autoreset(both, both)["held"].tolist() == [[7.0], [2.0], [0.0]]
