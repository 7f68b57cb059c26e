"""Repeated pictures and the lag between pictures and states, of recordings where both are known."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.data import replay_for_tests as shared
from tests.data.lerobot.lerobot_folder import write_version_2
from torch_denkf.data import LeRobotReplay, lag_errors
from torch_denkf.data.lerobot.repeats import repeated_pictures
from torch_denkf.data.lerobot.rows import recording_from_rows

EPISODES, LENGTH, SIZE = 20, 60, (24, 32)


def joints(generator):
    """Returns two smooth joint paths of every episode, ``[EPISODES, LENGTH + 20, 2]``, with room on both sides."""
    step = torch.arange(LENGTH + 20) / 10
    phase = 6.3 * torch.rand(EPISODES, 2, 3, generator=generator)
    pace = torch.tensor([0.7, 1.3, 2.1])
    return (step.view(1, -1, 1, 1) * pace + phase.unsqueeze(1)).sin().sum(-1) / 3


def drawn(place):
    """Returns a soft spot at ``place`` [n, 2] in -1..1, uint8 ``[n, 3, H, W]``."""
    rows, columns = (torch.linspace(-1.2, 1.2, n) for n in SIZE)
    down, right = (place[:, k].view(-1, 1, 1) for k in (0, 1))
    spot = (-((rows.view(-1, 1) - down) ** 2 + (columns - right) ** 2) / 0.8).exp()
    return (40 + 180 * spot).round().to(torch.uint8).unsqueeze(1).expand(-1, 3, -1, -1).contiguous()


def recording(lag, repeats=None, noise=0.0):
    """Pictures show the joints as the state has them ``lag`` rows later; rows of ``repeats`` show the one before."""
    generator = torch.Generator().manual_seed(5)
    path = joints(generator)
    state = path[:, 10 : 10 + LENGTH]
    pictures = torch.stack([drawn(one[10 + lag : 10 + lag + LENGTH]) for one in path])
    if repeats is not None:
        for row in range(1, LENGTH):
            pictures[:, row] = torch.where(repeats[:, row].view(-1, 1, 1, 1), pictures[:, row - 1], pictures[:, row])
    if noise:  # of a codec: few pixels, by one
        flip = torch.rand(pictures.shape, generator=generator) < noise
        pictures = pictures + flip.to(torch.uint8)
    rows = TensorDict(
        {
            "observation": {"image": pictures.flatten(0, 1), "state": state.flatten(0, 1)},
            "action": state.flatten(0, 1) + 100,
            "episode": torch.arange(EPISODES).repeat_interleave(LENGTH),
        },
        batch_size=[EPISODES * LENGTH],
    )
    return recording_from_rows(rows, fps=10.0), state


# Repeats --------------------------------------------------------------------------------------------------------------


def test_repeats_are_those_that_were_written():
    repeats = torch.rand(EPISODES, LENGTH, generator=torch.Generator().manual_seed(1)) < 0.3
    repeats[:, 0] = False
    record, _ = recording(0, repeats, noise=0.02)
    data = LeRobotReplay(record, split="all", repeats="mask")
    assert (data[:]["observed"].view(EPISODES, LENGTH) == ~repeats).all()
    assert data.repeats_masked == int(repeats.sum())
    kept = LeRobotReplay(record, split="all")
    assert kept[:]["observed"].all()
    assert kept.repeats_masked == 0
    shared.check_contract(data)


def test_an_episode_does_not_repeat_the_one_before():
    pictures = torch.full((4, 3, 4, 4), 7, dtype=torch.uint8)
    first = torch.tensor([True, False, True, False])
    assert repeated_pictures(pictures, torch.arange(4), first).tolist() == [False, True, False, True]


def test_the_picture_before_a_gap_counts():
    pictures = torch.tensor([9, 0, 9, 60], dtype=torch.uint8).view(4, 1, 1, 1).expand(4, 3, 4, 4)
    shown = torch.tensor([0, -1, 2, 3])
    found = repeated_pictures(pictures, shown, torch.arange(4) == 0)
    assert found.tolist() == [False, False, True, False]


def test_threshold_is_in_grey_levels():
    pictures = torch.stack([torch.zeros(3, 10, 10), torch.zeros(3, 10, 10)]).to(torch.uint8)
    pictures[1].view(-1)[:30] = 1  # 0.1 on average
    rows = torch.arange(2)
    assert not repeated_pictures(pictures, rows, rows == 0, threshold=0.0999)[1]
    assert repeated_pictures(pictures, rows, rows == 0, threshold=0.1001)[1]


# Lag ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [3, 0, -2])
def test_lag_is_found_and_paired(lag):
    record, state = recording(lag)
    errors = lag_errors(LeRobotReplay(record))
    assert min(errors, key=errors.get) == lag
    data = LeRobotReplay(record, split="all", lag=lag)
    rows = data[:]
    count = LENGTH - abs(lag)
    assert [episode.length for episode in data.episodes] == [count] * EPISODES
    # The oracle: what each row's picture shows is its state.
    torch.testing.assert_close(rows["pixels"], drawn(rows["state"]).float() / 255)
    late, early = max(lag, 0), max(-lag, 0)
    assert (rows["state"].view(EPISODES, count, 2) == state[:, late : LENGTH - early]).all()
    assert (rows["action"] == rows["state"] + 100).all()
    assert (rows["step"].view(EPISODES, count) == torch.arange(count)).all()
    np.testing.assert_allclose(rows["time"].view(EPISODES, count), np.tile(np.arange(count) / 10, (EPISODES, 1)))
    shared.check_contract(data)


def test_lag_with_repeats():
    """A repeat belongs to its picture, whichever row that is paired with."""
    repeats = torch.zeros(EPISODES, LENGTH, dtype=torch.bool)
    repeats[:, [4, 5, 20]] = True
    record, _ = recording(3, repeats)
    data = LeRobotReplay(record, split="all", lag=3, repeats="mask")
    assert (data[:]["observed"].view(EPISODES, -1) == ~repeats[:, : LENGTH - 3]).all()
    early = LeRobotReplay(record, split="all", lag=-5, repeats="mask")
    seen = early[:]["observed"].view(EPISODES, -1)
    assert seen[:, 0].all()  # row 5 repeats one that is not there any more
    assert (~seen).nonzero()[:, 1].unique().tolist() == [15]
    errors = lag_errors(LeRobotReplay(record, repeats="mask"))
    assert min(errors, key=errors.get) == 3


def test_statistics_are_of_the_pictures_that_are_offered():
    record, _ = recording(4)
    data = LeRobotReplay(record, split="train", lag=4)
    seen = data[:]["pixels"]
    torch.testing.assert_close(data.statistics["pixels", "mean"].flatten(), seen.mean((0, 2, 3)))


def test_from_a_folder(tmp_path):
    write_version_2(tmp_path, [9, 6, 12, 7, 8])
    plain = LeRobotReplay(tmp_path, size=SIZE, cache=None, split="all")
    data = LeRobotReplay(tmp_path, size=SIZE, cache=None, split="all", lag=2, repeats="mask")
    first, moved = plain.episodes[2], data.episodes[2]
    assert moved.length == 10
    rows, all_rows = data[moved.start : moved.start + 10], plain[first.start : first.start + 12]
    assert (rows["state"] == all_rows["state"][2:]).all()
    assert (rows["pixels"] == all_rows["pixels"][:10]).all()
    assert data.repeats_masked == 0  # neighbours differ by 14 levels
