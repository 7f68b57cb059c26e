"""Holds what tests of the data sets share: ways to ask for slices, what holds for them, and a bar that counts."""

import numpy as np
import torch
from torchrl.data import SliceSampler, SliceSamplerWithoutReplacement


def ways_to_slice():
    """Returns options for slices of 6 rows, each with a new sampler, because samplers cache the episodes' ends."""
    return [
        {"num_slices": 4},
        {"slice_len": 6},
        {"sampler": SliceSampler(num_slices=4)},
        {"sampler": SliceSampler(num_slices=4, end_key=("next", "done"))},
        {"sampler": SliceSamplerWithoutReplacement(num_slices=2), "batch_size": 12},
        {"num_slices": 4, "prefetch": 2},
        {"num_slices": 4, "slice_len": 6, "batch_size": None},
    ]


def check_contract(data):
    """The keys that every data set has, their shapes and types, and what holds between them."""
    rows = data[:]
    assert {episode.name for episode in data.episodes} == {*map(str, (e.name for e in data.episodes))}
    assert len({episode.name for episode in data.episodes}) == len(data.episodes)
    shapes = {key: (tuple(rows[key].shape), rows[key].dtype) for key in ("episode", "step", "time", "is_init")}
    count = len(data)
    assert shapes == {
        "episode": ((count,), torch.int64),
        "step": ((count, 1), torch.int64),
        "time": ((count, 1), torch.float64),
        "is_init": ((count, 1), torch.bool),
    }
    start = 0
    for number, episode in enumerate(data.episodes):
        assert episode.start == start
        start += episode.length
        mine = rows[episode.start : start]
        assert (mine["episode"] == number).all()
        assert mine["step"].flatten().tolist() == list(range(episode.length))
        assert mine["time"][0] == 0
        assert (mine["time"].diff(dim=0) > 0).all()
        assert mine["is_init"].flatten().tolist() == [True] + [False] * (episode.length - 1)
        end = [False] * (episode.length - 1) + [True]
        assert mine["next", "done"].flatten().tolist() == mine["next", "truncated"].flatten().tolist() == end
    assert start == count
    assert not rows["next", "terminated"].any()
    assert not (rows["done"] | rows["truncated"] | rows["terminated"]).any()
    assert not [key for key in rows.keys(True) if "_row" in key]
    for key in {"state", "action", "pixels"} & set(rows.keys()):
        assert rows[key].dtype == torch.float32
    if "pixels" in rows:
        assert rows["observed"].shape == (count, 1)
        assert rows["observed"].dtype == torch.bool


def check_indices(data):
    """One row, and rows in any order and shape, are those of ``data[:]``."""
    rows = data[:]
    assert data[5].batch_size == ()
    for index in (5, torch.tensor([7, 3, 3]), torch.tensor([[7, 3], [2, 8]])):
        part = data[index]
        for key in ("pixels", "state", "episode", "step"):
            assert part[key].equal(rows[key][index]), key


def mean_brightness(rows):
    return rows.select("episode").set("mean", rows["pixels"].mean((-3, -2, -1)).unsqueeze(-1))


def check_preprocess(data, folder):
    """TorchRL's preprocess sees rows with their pixels."""
    storage = data.preprocess(mean_brightness, num_workers=1, mp_start_method="fork", dest=folder)
    torch.testing.assert_close(storage[:]["mean"], data[:]["pixels"].mean((-3, -2, -1))[:, None])


def check_statistics(found, **values):
    """Means and standard deviations of numpy's over ``values``, each ``[n, C]``."""
    for key, column in values.items():
        for name, function in (("mean", np.mean), ("std", np.std)):
            expected = function(column.astype(np.float64), axis=0)
            np.testing.assert_allclose(found[key, name].flatten(), expected, rtol=3e-6, atol=1e-6, err_msg=key)


def check_slices(data, options, counter, keys):
    """Samples are slices of 6 rows, each in one episode, as they are stored; and all slices turn up."""
    torch.manual_seed(0)  # which slices turn up is chance
    rows = data[:]
    starts = set()
    for _ in range(40):
        batch = data.sample()
        slices = len(batch)
        few = isinstance(options.get("sampler"), SliceSamplerWithoutReplacement) and len(data.episodes) % 2
        assert batch.shape[1] == 6
        assert slices == data._batch_size // 6 or (few and slices == 1)
        assert (batch["episode"] == batch["episode"][:, :1]).all()
        assert (batch[counter].diff(dim=1) == 1).all()
        index = batch["index"].squeeze(-1)
        assert (index.diff(dim=1) == 1).all()
        for key in keys:
            assert (batch[key] == rows[key][index]).all(), key
        assert batch["is_init"].squeeze(-1).tolist() == [[True] + [False] * 5] * slices
        assert batch["next", "truncated"].squeeze(-1).tolist() == [[False] * 5 + [True]] * slices
        starts |= set(index[:, 0].tolist())
    if not isinstance(options.get("sampler"), SliceSamplerWithoutReplacement):
        possible = {e.start + k for e in data.episodes for k in range(e.length - 5)}
        assert starts <= possible
        assert len(starts) > 0.75 * len(possible)  # of those that there are, most have turned up in 160 draws
