"""What tests of the data sets share: ways to ask for slices, what holds for them, and a bar that counts."""

import torch
from torchrl.data import SliceSampler, SliceSamplerWithoutReplacement


def ways_to_slice():
    """Options that each ask for slices of 6 rows; new samplers each time, since they remember where episodes end."""
    return [
        {"num_slices": 4},
        {"slice_len": 6},
        {"sampler": SliceSampler(num_slices=4)},
        {"sampler": SliceSampler(num_slices=4, end_key=("next", "done"))},
        {"sampler": SliceSamplerWithoutReplacement(num_slices=2), "batch_size": 12},
        {"num_slices": 4, "prefetch": 2},
    ]


def check_slices(data, options, counter, keys):
    """Samples are slices of 6 rows, each in one episode, as they are stored; and all slices turn up."""
    torch.manual_seed(0)  # which slices turn up is chance
    rows = data[:]
    starts = set()
    for _ in range(40):
        flat = data.sample()
        batch = flat.reshape(-1, 6)
        slices = len(batch)
        assert slices == data._batch_size // 6
        assert (batch["episode"] == batch["episode"][:, :1]).all()
        assert (batch[counter].diff(dim=1) == 1).all()
        index = flat["index"].reshape(-1, 6)
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


def counting_bars(monkeypatch):
    """Puts a bar that counts in the place of tqdm's, and returns the list of those that appear."""
    bars = []

    class Bar:
        def __init__(self, total, disable, delay, initial=0, **_):
            self.total, self.n, self.closed = total, initial, False
            assert delay >= 10  # silent without a terminal, unless it takes long
            if disable:
                return
            bars.append(self)

        def update(self, count):
            self.n += count

        def close(self, *_):
            self.closed = True

        __enter__ = lambda self: self  # noqa: E731
        __exit__ = close

    monkeypatch.setattr("torch_denkf._progress.tqdm", Bar)
    return bars
