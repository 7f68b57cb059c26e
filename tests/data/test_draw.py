"""Samples of a data set that follow a generator, as stages of a training draw them."""

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.data import Episode, EpisodeReplay


def numbered(**options):
    step = torch.arange(10).repeat(3).unsqueeze(-1)
    rows = TensorDict({"step": step, "time": step * 0.1, "row": torch.arange(30).unsqueeze(-1)}, [30])
    episodes = [Episode(name, 10 * k, 10) for k, name in enumerate("abc")]
    return EpisodeReplay(rows, episodes, for_tests=lambda episode: False, **options)


@pytest.mark.parametrize(
    "options",
    [{"num_slices": 4, "slice_len": 5}, {"num_slices": 4, "batch_size": 20}, {"slice_len": 5, "batch_size": 20}],
)
@pytest.mark.parametrize("length", [None, 3])
def test_the_generator_alone_decides(options, length):
    """After other draws, from another data set, and whatever torch's own generator does: the same rows."""
    first = numbered(**options).draw(torch.Generator().manual_seed(3), length)["row"].squeeze(-1)
    data = numbered(**options)
    data.draw(torch.Generator().manual_seed(4), 2)
    torch.manual_seed(9)
    again = data.draw(torch.Generator().manual_seed(3), length)["row"].squeeze(-1)
    assert first.equal(again)
    assert first.shape == (4, length or 5)
    assert (first.diff(dim=-1) == 1).all()  # slices of one episode each
    assert (first // 10 == first[:, :1] // 10).all()
    assert data.draw(torch.Generator().manual_seed(5)).shape == (4, 5)  # another length is for once
